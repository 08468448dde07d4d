"""Reactive obstacle avoidance as Drake systems (Pairet et al., RA-L 2019)."""


"""Simulating a scenario; its log, metrics, report, plots and replay."""

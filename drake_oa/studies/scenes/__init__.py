"""Synthetic scenes of ellipsoids: suites, methods, and their judge."""

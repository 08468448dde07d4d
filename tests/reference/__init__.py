"""Readable reference forms of compiled functions, and synthetic data, for comparisons in tests."""

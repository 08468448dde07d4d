"""Diagrams (wiring) and the scenarios beside them."""

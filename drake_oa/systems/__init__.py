"""The layers, one Drake LeafSystem a file."""

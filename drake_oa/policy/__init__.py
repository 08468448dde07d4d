"""The movement primitives of position and orientation, with their coupling terms."""

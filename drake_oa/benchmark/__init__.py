"""How long the layers take."""

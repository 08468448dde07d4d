"""What the layers think, drawn into Meshcat."""

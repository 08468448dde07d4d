"""The simulated station: robot and obstacles in a plant, cameras, noise and faults."""

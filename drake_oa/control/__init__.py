"""From the desired motion of the tool to torques: inverse dynamics in operational space."""

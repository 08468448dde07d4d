"""What slows, holds or stops a motion, and gets the arm out of the way."""

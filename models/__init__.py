"""Models of robot, obstacles and scenes, demonstrations, trained weights (package://drake_oa)."""

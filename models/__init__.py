"""Robot, obstacle and scene models, and trained weights (package://drake_oa)."""

"""Robot, obstacle and scene models, recorded motions, trained weights (package://drake_oa)."""

"""On which side of each obstacle the motion passes: the paper's cost rings."""

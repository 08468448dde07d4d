"""The arm's posture along a motion: planned, followed, turned from obstacles."""

"""MotionBenchMaker's problems."""

"""The paper's experiments and those beyond it: suites of scenes, methods, and their judge."""

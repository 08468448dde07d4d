"""Readable forms of what the package has compiled: slow, plain, and compared with it."""

"""Ellipsoids, superquadrics, primitives, voxels and clusters: geometry without a robot."""

"""The arm: kinematics as arrays, inverse kinematics, limits and what it can reach."""

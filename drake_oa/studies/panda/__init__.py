"""Random scenes of the simulated Panda, and peers to compare with."""

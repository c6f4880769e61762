"""Stiffness of flexible objects from robot recordings, and a diagnosis of the sim-to-real gap that is left."""

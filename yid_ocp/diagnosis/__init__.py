"""Diagnosis of the sim-to-real gap: whether it exists, where it is, and which effects cause and close it."""

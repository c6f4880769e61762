"""Motions planned with the identified model."""

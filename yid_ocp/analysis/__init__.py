"""Analyses of a model and of an estimation: identifiability, data quality, convergence. None changes its input."""

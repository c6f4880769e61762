"""Read-only analyses of a model and of an estimation: identifiability, data quality, convergence, structure."""

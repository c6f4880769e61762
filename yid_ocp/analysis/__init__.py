"""Read-only analyses of a model and of an estimation, such as identifiability, data quality and convergence."""

"""Export models, equations and signals."""

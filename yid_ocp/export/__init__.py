"""Export of models, equations and signals."""

"""Export of models, equations and signals to files of other tools."""

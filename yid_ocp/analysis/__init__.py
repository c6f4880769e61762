"""Analyses of a model or a fit, such as identifiability, intervals and data checks. None changes its input."""

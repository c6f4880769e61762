"""Export of recordings, models and equations; one file per format."""

"""Configuration files: the settings of a run, a reader that checks them, and a JSON Schema for editors."""

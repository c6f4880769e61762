"""Configuration files: the settings of a run, a reader that checks them, and a schema for editors."""

"""Configuration files: the settings of a run, the reader that checks them, the schema for editors."""

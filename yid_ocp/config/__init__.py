"""Configuration files, with the settings of a run, a checking reader, and a schema for editors."""

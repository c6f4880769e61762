"""Configuration files: settings of a run, a reader with checks, and a schema for editors."""

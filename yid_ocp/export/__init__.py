"""Recordings written in other formats; one file a format."""

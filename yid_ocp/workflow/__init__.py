"""Library functions behind the commands. A new command is one file here and one row in `cli`."""

"""The library calls behind the commands; a new command is one file here and one row in `cli`."""

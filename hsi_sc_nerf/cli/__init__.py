"""Command line: the commands, by what they work on."""

"""Captures on disk: ENVI cubes, the folders and metadata of a SPECIM IQ, and sessions."""

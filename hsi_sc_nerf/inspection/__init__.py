"""Checks of a session before it is believed: its files, its white, its frames, its markers."""

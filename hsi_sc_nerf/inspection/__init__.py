"""Checks of a session before its processing: its files, white reference, frames and markers."""

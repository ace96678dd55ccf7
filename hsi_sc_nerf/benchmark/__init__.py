"""Configurations trained and timed alike: accuracy against training time."""

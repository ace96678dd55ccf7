"""Simulator of turntable sessions with known truth."""

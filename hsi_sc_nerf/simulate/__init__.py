"""Turntable sessions with known truth, rendered from a scene file."""

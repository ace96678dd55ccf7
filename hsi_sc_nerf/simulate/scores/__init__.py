"""Errors of processing and analysis against the truth of simulated sessions."""

"""Spectral point clouds."""

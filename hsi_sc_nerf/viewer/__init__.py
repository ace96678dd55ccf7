"""Spectral controls and images for nerfstudio's viewer."""

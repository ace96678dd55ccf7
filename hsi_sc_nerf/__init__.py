"""Hyperspectral 3D reconstruction of turntable captures: a nerfstudio plugin."""

__version__ = "0.1.0"

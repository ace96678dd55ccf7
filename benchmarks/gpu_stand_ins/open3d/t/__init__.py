"""Open3D's tensor interface: ray casting."""

from . import geometry

__all__ = ["geometry"]

"""The parts of Open3D that this project uses, by embreex; only benchmarks/gpu.py puts them on the path."""

from . import core, t

__all__ = ["core", "t"]

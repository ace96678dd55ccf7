"""The spectral radiance field."""

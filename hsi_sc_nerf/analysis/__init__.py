"""Traits of a spectral cloud: sizes, classes, indices, regions."""

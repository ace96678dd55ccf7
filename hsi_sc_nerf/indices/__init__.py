"""Spectral indices: formulas of reflectances, and the catalogue of usual ones."""

"""What spectra tell: named composites and spectral indices, for pictures, tables and reports alike."""

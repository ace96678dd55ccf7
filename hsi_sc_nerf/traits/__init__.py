"""What a plant scientist measures on a spectral cloud: size, spectra of regions, classes and their areas."""

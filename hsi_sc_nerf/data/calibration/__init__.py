"""From counts to reflectance: white and dark references, defects, drift of the lamps, uncertainty."""

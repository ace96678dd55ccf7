"""Raw counts to reflectance: white and dark references, detector defects, noise, lamp drift."""

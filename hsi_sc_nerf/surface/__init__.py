"""The surface of a trained field: where it is, points on it, which frames see it."""

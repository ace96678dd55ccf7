"""Cameras, rays and similarity transformations; pure functions on arrays."""

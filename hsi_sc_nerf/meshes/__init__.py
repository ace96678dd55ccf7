"""Triangle meshes as plain arrays."""

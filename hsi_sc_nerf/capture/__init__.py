"""What the instrument leaves on disk: ENVI cubes, captures, sessions."""

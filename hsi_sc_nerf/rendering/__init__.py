"""Views of a trained field as cubes, pictures and videos."""

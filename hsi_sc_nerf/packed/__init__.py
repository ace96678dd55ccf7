"""The packed dataset on disk: its format, its cubes, reading them pixel by pixel."""

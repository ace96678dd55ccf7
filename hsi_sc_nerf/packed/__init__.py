"""The packed dataset on disk: its format, its cubes, and its pixels."""

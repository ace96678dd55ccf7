"""From raw ENVI cubes to a packed dataset, and from there to training batches."""

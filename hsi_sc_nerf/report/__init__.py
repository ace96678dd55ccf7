"""One HTML file that tells how a run came about and how good it is; it opens without a network."""

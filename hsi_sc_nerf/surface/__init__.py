"""The surface of a trained model: depth maps, mesh, evenly spread points, and the frames that see them."""

"""What notebooks and scripts open: a trained run, and a cloud of its points. `hsi_sc_nerf` has the names."""

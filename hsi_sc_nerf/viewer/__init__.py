"""What `ns-viewer`, and the viewer of a training run, show of spectra."""

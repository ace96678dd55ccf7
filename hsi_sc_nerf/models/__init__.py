"""Losses, metrics, the model and its two-stage training."""

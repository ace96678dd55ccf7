"""Spatial scores and pictures to check a reconstruction by."""

"""Figures and false colours."""

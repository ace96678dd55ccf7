"""How well a simulated session was processed, against its known truth."""

"""Many sessions: one table and one page of all objects."""

"""What accuracy costs in time: named configurations trained alike, and tables and pictures of how they did."""

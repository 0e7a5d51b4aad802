"""Files: bags, trajectory database, CSV tables."""

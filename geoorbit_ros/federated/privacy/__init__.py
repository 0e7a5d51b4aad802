"""What hides a single client's update: secure aggregation and differential privacy."""

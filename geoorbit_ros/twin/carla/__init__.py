"""Shows the vehicles of the twin in a CARLA server."""

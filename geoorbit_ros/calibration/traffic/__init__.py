"""A camera's calibration from the vehicles that drive through its image, without any point."""

"""What was found, in words and on one HTML page."""

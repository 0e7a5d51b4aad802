"""Road markings: lane lines in the camera's image, and lanes whose boundaries follow them."""

"""One thin rclpy node per file."""

"""The traffic that was counted, in tables and pictures on one HTML page."""

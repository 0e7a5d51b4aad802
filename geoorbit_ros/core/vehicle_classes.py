"""Which COCO class numbers are vehicles: detectors give them, lanes and learning count them."""

UNKNOWN_CLASS = -1
"""A tracker that was told no class: its tracks are taken for vehicles."""
LARGE_CLASSES = (5, 7)
"""Bus and truck."""
VEHICLE_CLASSES = (UNKNOWN_CLASS, 2, 3, *LARGE_CLASSES)
"""Car, motorcycle, bus and truck. People and bicycles have paths that are no lanes."""
VEHICLE_CLASS_TEXT = "2 (car), 3 (motorcycle), 5 (bus), 7 (truck) or -1 (unknown)"

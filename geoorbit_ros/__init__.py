"""Geo-ORBIT: live lane maps and digital twins from roadside cameras, as ROS 2 nodes."""

import os

__version__ = "0.1.0"

MAX_IMAGE_PIXELS = 1 << 26
"""Largest image that is decoded, 67 megapixels: two images of 8K. A PNG of 900 kB can have 900
megapixels, and take 5 GB and a minute. The variable below, if set, goes before."""
# OpenCV reads it once, when it is imported: by the package's other modules, after this line.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_IMAGE_PIXELS))

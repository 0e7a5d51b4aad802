"""Geo-ORBIT: live lane maps and digital twins from roadside cameras, as ROS 2 nodes."""

__version__ = "0.1.0"

"""Vehicles in images: one detector per file behind one protocol, and where the road is."""

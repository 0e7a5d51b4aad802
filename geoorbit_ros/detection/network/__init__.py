"""Vehicles found by a small network that ships with the package, for fixed cameras."""

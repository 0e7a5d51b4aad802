"""Simulates the traffic of the next minutes, starting from what the twin saw."""

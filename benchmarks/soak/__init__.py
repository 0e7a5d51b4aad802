"""Fleets that run for minutes, and what they cost meanwhile."""

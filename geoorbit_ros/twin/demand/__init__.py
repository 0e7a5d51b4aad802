"""Demand for SUMO from counted vehicles: counts with bounds, and scenarios of whole days."""

"""Fleets: what one file says about many cameras, and the processes that make it so."""

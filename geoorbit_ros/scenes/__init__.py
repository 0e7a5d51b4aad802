"""Synthetic roadside cameras with exact ground truth."""

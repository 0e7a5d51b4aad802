"""Compares a map with the lanes that are driven, and corrects it."""

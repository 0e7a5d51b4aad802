"""The traffic of the next minutes, simulated ahead from what the twin saw."""

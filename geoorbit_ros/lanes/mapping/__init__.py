"""The lane map of a running camera: when it is derived, ids, memory, state."""

"""Sends the graph's messages to viewers over Foxglove's WebSocket protocol."""

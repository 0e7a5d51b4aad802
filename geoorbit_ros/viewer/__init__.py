"""What viewers see: the graph's messages over Foxglove's WebSocket protocol."""

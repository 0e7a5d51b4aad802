"""Federated learning: wire format, strategies, client and server as plain state machines."""

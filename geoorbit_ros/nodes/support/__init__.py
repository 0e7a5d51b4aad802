"""What nodes are made of: parameters, diagnostics, topics, processes."""

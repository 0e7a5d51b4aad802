"""How wrong a lane map is, in terms a traffic engineer uses."""

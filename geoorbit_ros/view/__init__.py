"""How a camera's image moves against its reference view, and when it shows none of its views."""

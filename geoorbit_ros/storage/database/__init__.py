"""The trajectory database in SQLite."""

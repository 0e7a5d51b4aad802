"""Types every other package shares: tables, lanes, errors. Depends on numpy alone."""

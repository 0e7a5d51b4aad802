"""The `geoorbit` command."""

"""The commands `geoorbit twin …`."""

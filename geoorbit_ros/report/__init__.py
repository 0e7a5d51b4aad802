"""Reports what was found: sentences, an HTML page, drawings on images."""

"""Lane estimators, one file or folder each, behind one protocol."""

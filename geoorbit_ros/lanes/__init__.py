"""Lane estimators behind one protocol, the continuous lane mapper, GeoJSON."""

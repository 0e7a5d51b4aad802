"""Moving vehicles in front of the empty road, for fixed cameras; no model file."""

"""How a vector of weights becomes bytes: one encoding per file."""

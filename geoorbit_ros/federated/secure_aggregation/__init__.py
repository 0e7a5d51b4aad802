"""Sums of updates of which the server sees no summand (Bonawitz et al. 2017)."""

"""How wrong detectors, tracks, twins and map checks are: for benchmarks and tests alone."""

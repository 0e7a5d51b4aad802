"""Road networks: SUMO network files, lanes as arrays, netconvert, reference lanes."""

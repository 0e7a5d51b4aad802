"""The digital twin: SUMO networks, reference lanes, and vehicles that move as the tracks say."""

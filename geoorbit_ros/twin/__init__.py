"""The digital twin: a SUMO simulation whose vehicles move as the cameras' tracks say."""

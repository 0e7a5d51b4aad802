"""Lane maps in the formats of other programs: OpenDRIVE, Lanelet2, SUMO."""

"""Meta-GeoLane: lane-estimator parameters predicted from the scene, and how that is learned."""

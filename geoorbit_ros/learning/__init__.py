"""Meta-GeoLane: detection parameters predicted from the scene, and how that is learned."""

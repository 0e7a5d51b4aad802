"""What a roadside camera over a synthetic road would show: images with exact boxes."""

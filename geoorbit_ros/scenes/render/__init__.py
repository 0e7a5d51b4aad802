"""What a roadside camera over a synthetic road would show: pictures with exact boxes."""

"""Where a map differs from the lanes that are driven, and the corrected map."""

"""From boxes frame by frame to tracks with lasting ids. Depends on numpy and scipy alone."""

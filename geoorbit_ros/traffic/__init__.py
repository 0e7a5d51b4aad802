"""Traffic per lane: who drove where, how fast, and the measures of traffic engineering from it."""

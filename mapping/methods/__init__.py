"""How landmarks are made: depth, matches, or a known model."""

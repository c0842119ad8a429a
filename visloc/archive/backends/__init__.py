"""Where a store keeps its maps: a folder."""

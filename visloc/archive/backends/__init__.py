"""Where a store keeps its maps: a folder, or object storage with local copies."""

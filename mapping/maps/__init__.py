"""Maps that exist: edited, packed, exported, split, merged, pruned, updated."""

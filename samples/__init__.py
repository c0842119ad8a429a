"""The sample world: a furnished room made from a seed, photographed with exact poses and depth."""

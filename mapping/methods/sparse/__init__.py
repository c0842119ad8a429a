"""Sparse models: poses and points of verified matches, by pycolmap, and what contradicts them."""

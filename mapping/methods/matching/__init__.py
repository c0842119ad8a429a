"""Pairs of photos: matched, and verified by the geometry of two views."""

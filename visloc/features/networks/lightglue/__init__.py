"""LightGlue."""

"""Local features without a network."""

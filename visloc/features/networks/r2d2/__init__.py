"""R2D2 and Fast-R2D2."""

"""Methods that make landmarks: from depth, matches, or a known model."""

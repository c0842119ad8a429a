"""Image retrieval with several fused global descriptors."""

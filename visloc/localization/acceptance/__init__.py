"""Whether to believe a pose: the gates, the evidence, and other places that explain a photo too."""

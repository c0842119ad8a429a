"""From 2D-3D correspondences to a pose with its uncertainty."""

"""From descriptors to 2D-3D correspondences."""

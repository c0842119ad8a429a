"""Scans of phones, with poses of ARKit and depth of LiDAR, as apps write them."""

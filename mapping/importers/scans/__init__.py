"""Scans of phones: folders that scanning apps write, with poses of ARKit and depth of LiDAR.

Worlds are metric, with y up. Each app's file says whose documentation or source its layout is from.
"""

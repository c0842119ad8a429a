"""Adds the global descriptors ``apgem``, ``delg`` and ``netvlad``; weights are the user's."""

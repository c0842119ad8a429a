"""Adds ``--executor ray``: builds on a Ray cluster."""

"""Adds the local features ``aliked`` and ``aliked-t16``: ALIKED, by torch."""

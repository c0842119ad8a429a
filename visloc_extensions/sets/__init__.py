"""Searching a set of maps: its tiles for a photo, and one answer (README.md)."""

"""A map's own test, and the publishing of maps that took it."""

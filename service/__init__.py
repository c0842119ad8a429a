"""The online server: ``python -m service``."""

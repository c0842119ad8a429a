"""API keys, limits and TLS."""

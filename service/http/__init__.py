"""The HTTP API: the ASGI app and its routes."""

"""Films, as frames."""

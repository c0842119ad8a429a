"""Maps served, work queued. Knows neither HTTP nor gRPC."""

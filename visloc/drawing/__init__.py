"""Pictures of matches and of maps."""

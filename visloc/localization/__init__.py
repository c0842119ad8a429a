"""From one query to its pose, or a refusal."""

"""What /openapi.json says: bodies, examples, problems."""

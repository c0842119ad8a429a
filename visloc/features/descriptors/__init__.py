"""Global descriptors."""

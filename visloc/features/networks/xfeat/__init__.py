"""XFeat."""

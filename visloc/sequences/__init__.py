"""Instants in order: solved together, gaps filled."""

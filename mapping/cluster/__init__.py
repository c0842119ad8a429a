"""Executors of a build's work, and the storage of its results."""

"""Stages of a build: what is computed once, kept by the hash of its inputs, and used again."""

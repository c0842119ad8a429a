"""Backends of a store of maps; the one here keeps them in a folder."""

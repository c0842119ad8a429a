"""Frames of videos, for the extensions ``capture`` and ``scans``, which need it."""

"""Parts that several importers share: text, JSON, names of photos, tracks, measurements."""

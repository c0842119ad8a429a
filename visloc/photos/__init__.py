"""Photos as files: their formats, metadata and pixels."""

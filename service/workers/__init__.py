"""Worker processes and what runs inside them."""

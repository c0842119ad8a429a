"""Files of network weights."""

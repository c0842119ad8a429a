"""Networks: each with its backends."""

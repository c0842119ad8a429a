"""What these commands compare and score."""

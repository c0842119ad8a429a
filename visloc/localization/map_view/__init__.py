"""Where the photos of a map stand, what priors leave of them, and landmarks on demand."""

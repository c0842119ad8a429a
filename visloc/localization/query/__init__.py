"""What is known of a query before it is solved: its camera, its features, the photos it names."""

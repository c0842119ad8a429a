"""How frames lie to each other and on Earth."""

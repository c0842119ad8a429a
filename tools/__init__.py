"""What the repository needs beside the product: its site, its supply chain, its sizes."""

"""Commands that maintain the repository: its site, supply chain, sizes, and the core alone."""

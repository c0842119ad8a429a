"""The site that ``make site`` writes: Sphinx over README.md and docs/."""

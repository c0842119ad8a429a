"""``make results``: tables of docs/results.md, each with the commit and date of its run."""

"""Many queries: batches and benchmarks."""

"""Many queries: batches, benchmarks, comparisons."""

"""Maps that change: ``mapping update``, ``merge`` and ``prune``."""

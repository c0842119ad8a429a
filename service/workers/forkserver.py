"""What the process does that worker processes are forked from, before the first of them.

It is imported there and nowhere else.
"""

from __future__ import annotations

import signal

import service.workers.vision  # noqa: F401  loaded once, for all of them

# Who stops the service by its group of processes means the main process: it lets requests end.
signal.signal(signal.SIGTERM, signal.SIG_IGN)

"""Preparation of the process that worker processes are forked from; imported only there."""

from __future__ import annotations

import gc
import signal

import service.workers.vision  # noqa: F401  loaded once, for all of them
from visloc.localization.preloading import load_torch_if_sure

load_torch_if_sure()

# A signal to the group of processes is for the main process, which lets requests end.
signal.signal(signal.SIGTERM, signal.SIG_IGN)
# Workers never look for garbage among what was loaded here: that would write to all of it, so that
# each worker had a copy, and would make a photo wait for a tenth of a second.
gc.freeze()

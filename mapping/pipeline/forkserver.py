"""Preparation of the process that a build's workers are forked from; imported only there."""

from __future__ import annotations

import signal

import mapping.pipeline.build  # noqa: F401  what tasks of a build need
from visloc.localization.preloading import load_torch_if_sure

load_torch_if_sure()
# pycolmap would answer SIGTERM with a stack trace.
signal.signal(signal.SIGTERM, signal.SIG_DFL)

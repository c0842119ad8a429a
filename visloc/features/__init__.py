"""Local features and global descriptors, by name.

A further one is one file and one line in a registry below. Nothing here loads torch or OpenCV
until a feature is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import cast

from visloc.errors import InvalidInput
from visloc.features.base import Fingerprint, GlobalDescriptor, LocalFeatureExtractor
from visloc.types import Inference

__all__ = [
    "DEFAULT_GLOBAL_FEATURES",
    "DEFAULT_LOCAL_FEATURES",
    "GLOBAL_FEATURES",
    "LOCAL_FEATURES",
    "Fingerprint",
    "GlobalDescriptor",
    "LocalFeatureExtractor",
    "make_global_descriptor",
    "make_local_features",
]

# name -> module and function, which takes the folder with weights or None, how networks are
# computed, and with how many threads.
LOCAL_FEATURES: Mapping[str, tuple[str, str]] = {
    "faster2d2": ("visloc.features.r2d2", "load_faster2d2"),
    "r2d2": ("visloc.features.r2d2", "load_r2d2"),
    "sift": ("visloc.features.sift", "load_sift"),
    "xfeat": ("visloc.features.xfeat", "load_xfeat"),
}
GLOBAL_FEATURES: Mapping[str, tuple[str, str]] = {
    "densevlad": ("visloc.features.densevlad", "load_densevlad"),
    "localvlad": ("visloc.features.localvlad", "load_localvlad"),
}
# XFeat is free for any use and fast; R2D2's published weights are for research only.
DEFAULT_LOCAL_FEATURES = "xfeat"
DEFAULT_GLOBAL_FEATURES = ("densevlad", "localvlad")


def make_local_features(
    name: str,
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Build the extractor that a command or a map names.

    Args:
        name: a name of ``LOCAL_FEATURES``.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        threads: processor threads for one photo; None for all processors.

    Raises:
        InvalidInput: ``features.unknown``.
        WeightsError: when its weights are missing or not its own.
    """
    load = cast(
        "Callable[[Path | None, Inference, int | None], LocalFeatureExtractor]",
        _find(LOCAL_FEATURES, name, "local_features"),
    )
    return load(weights_dir, inference, threads)


def make_global_descriptor(
    name: str,
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> GlobalDescriptor:
    """Build the global descriptor that a command or a map names.

    Args:
        name: a name of ``GLOBAL_FEATURES``.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        threads: processor threads for one photo; None for all processors.

    Raises:
        InvalidInput: ``features.unknown``.
        WeightsError: when its weights are missing or not its own.
    """
    load = cast(
        "Callable[[Path | None, Inference, int | None], GlobalDescriptor]",
        _find(GLOBAL_FEATURES, name, "global_features"),
    )
    return load(weights_dir, inference, threads)


def _find(registry: Mapping[str, tuple[str, str]], name: str, field: str) -> object:
    if name not in registry:
        raise InvalidInput(
            "features.unknown",
            "unknown feature",
            field=field,
            expected=f"one of {', '.join(sorted(registry))}",
            got=name,
        )
    module, function = registry[name]
    return getattr(import_module(module), function)

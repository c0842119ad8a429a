"""Local features and global descriptors, by name.

To add one, write a file and a line in a registry below, or a plug-in
(``visloc.features.plugins``). Nothing here loads torch or OpenCV until a feature is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import cast

from visloc.errors import refuse
from visloc.features.base import Fingerprint, GlobalDescriptor, LocalFeatureExtractor
from visloc.features.descriptors.image_descriptor import ImageDescriptor
from visloc.features.plugins import (
    GLOBAL_FEATURES_GROUP,
    LOCAL_FEATURES_GROUP,
    make_plugin,
    passed_over,
    plugin_names,
)
from visloc.options import Inference

__all__ = [
    "DEFAULT_GLOBAL_FEATURES",
    "DEFAULT_LOCAL_FEATURES",
    "GLOBAL_FEATURES",
    "LOCAL_FEATURES",
    "Fingerprint",
    "GlobalDescriptor",
    "ImageDescriptor",
    "LocalFeatureExtractor",
    "check_local_features",
    "global_feature_names",
    "local_feature_names",
    "make_global_descriptor",
    "make_local_features",
]

# name -> module and function (weights_dir, inference, threads) -> extractor.
LOCAL_FEATURES: Mapping[str, tuple[str, str]] = {
    "faster2d2": ("visloc.features.networks.r2d2.load", "load_faster2d2"),
    "r2d2": ("visloc.features.networks.r2d2.load", "load_r2d2"),
    "sift": ("visloc.features.local.sift", "load_sift"),
    "xfeat": ("visloc.features.networks.xfeat.load", "load_xfeat"),
}
GLOBAL_FEATURES: Mapping[str, tuple[str, str]] = {
    "densevlad": ("visloc.features.descriptors.densevlad", "load_densevlad"),
    "localvlad": ("visloc.features.descriptors.vlad", "load_localvlad"),
}
# XFeat is free for any use and fast; R2D2's published weights are for research only.
DEFAULT_LOCAL_FEATURES = "xfeat"
DEFAULT_GLOBAL_FEATURES = ("densevlad", "localvlad")


def local_feature_names() -> list[str]:
    """Return the names of all installed local features, plug-ins included."""
    return sorted({*LOCAL_FEATURES, *plugin_names(LOCAL_FEATURES_GROUP)})


def global_feature_names() -> list[str]:
    """Return the names of all installed global descriptors, plug-ins included."""
    return sorted({*GLOBAL_FEATURES, *plugin_names(GLOBAL_FEATURES_GROUP)})


def check_local_features(name: str) -> None:
    """Refuse a name that no installed local features have, without loading any.

    Raises:
        InvalidInput: ``features.unknown``.
    """
    _refuse_unknown(LOCAL_FEATURES, LOCAL_FEATURES_GROUP, name)


def make_local_features(
    name: str,
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Build the extractor that a command or a map names.

    Args:
        name: one of ``local_feature_names``. Names of ``LOCAL_FEATURES`` come before plug-ins.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        threads: processor threads for one photo; None for all processors.

    Raises:
        InvalidInput: ``features.unknown``, ``features.plugin``, ``inference.unavailable``.
        WeightsError: when its weights are missing or not its own.
    """
    made = _make(LOCAL_FEATURES, LOCAL_FEATURES_GROUP, name, weights_dir, inference, threads)
    return cast("LocalFeatureExtractor", made)


def make_global_descriptor(
    name: str,
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> GlobalDescriptor:
    """Build a global descriptor by name, as ``make_local_features`` does local features."""
    made = _make(GLOBAL_FEATURES, GLOBAL_FEATURES_GROUP, name, weights_dir, inference, threads)
    return cast("GlobalDescriptor", made)


def _make(
    registry: Mapping[str, tuple[str, str]],
    group: str,
    name: str,
    weights_dir: Path | None,
    inference: Inference,
    threads: int | None,
) -> object:
    if name in registry:
        module, function = registry[name]
        return getattr(import_module(module), function)(weights_dir, inference, threads)
    _refuse_unknown(registry, group, name)
    return make_plugin(group, name, weights_dir, inference, threads)


def _refuse_unknown(registry: Mapping[str, tuple[str, str]], group: str, name: str) -> None:
    others = plugin_names(group)
    if name not in registry and name not in others:
        message = "the features are unknown; if a package provides them, install that package"
        unusable = passed_over(group)
        if unusable:
            message += (
                "; these names are not usable, because a name has at most 64 lower-case letters, "
                f"digits, '_', '.' and '-': {', '.join(unusable)}"
            )
        raise refuse(
            "features.unknown",
            message,
            field=group.removeprefix("visloc."),
            expected=sorted({*registry, *others}),
            got=name,
        )

"""The contract of local features, for those of the core."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from tests.visloc.features.local_features_contract import *  # noqa: F403
from visloc.features.base import LocalFeatureExtractor
from visloc.features.local.sift import load_sift
from visloc.features.networks.r2d2.load import load_faster2d2, load_r2d2
from visloc.features.networks.xfeat.load import load_xfeat

LOADERS = {
    "faster2d2": load_faster2d2,
    "faster2d2, published weights": load_faster2d2,
    "r2d2": load_r2d2,
    "sift": load_sift,
    "xfeat": load_xfeat,
}
NEEDS_WEIGHTS = {"faster2d2, published weights", "r2d2"}


@cache
def _load(name: str, weights_dir: Path | None) -> LocalFeatureExtractor:
    return LOADERS[name](weights_dir)


@pytest.fixture(params=sorted(LOADERS))
def extractor(request: pytest.FixtureRequest) -> LocalFeatureExtractor:
    weights_dir = None
    if request.param in NEEDS_WEIGHTS:
        weights_dir = request.getfixturevalue("shared_weights")
    return _load(request.param, weights_dir)

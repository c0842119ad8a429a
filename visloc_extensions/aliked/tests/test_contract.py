"""The contract of local features, for ALIKED."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from tests.visloc.features.local_features_contract import *  # noqa: F403
from visloc.features import make_local_features
from visloc.features.base import LocalFeatureExtractor

_load = cache(make_local_features)


@pytest.fixture(params=["aliked", "aliked-t16"])
def extractor(request: pytest.FixtureRequest, shared_weights: Path) -> LocalFeatureExtractor:
    return _load(request.param, shared_weights)

"""What the tests of features share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from visloc.errors import InvalidInput
from visloc.features.backends.choice import choose_inference
from visloc.options import Inference


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep calibrations out of the user's cache folder, and what lies there out of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def eight_bits() -> None:
    """Skip on a processor whose sums of 8-bit products may overflow."""
    try:
        choose_inference(Inference.INT8)
    except InvalidInput as error:
        pytest.skip(str(error))

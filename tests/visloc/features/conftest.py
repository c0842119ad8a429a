"""What the tests of features share."""

from __future__ import annotations

import pytest

from visloc.errors import InvalidInput
from visloc.features.backends.choice import choose_inference
from visloc.options import Inference


@pytest.fixture
def eight_bits() -> None:
    """Skip on a processor whose sums of 8-bit products may overflow."""
    try:
        choose_inference(Inference.INT8)
    except InvalidInput as error:
        pytest.skip(str(error))

"""Fixtures of the core's tests."""

from tests.e2e.test_page import browser  # noqa: F401
from tests.mapping.conftest import build_walk, walk  # noqa: F401
from tests.mapping.own_test.conftest import (  # noqa: F401
    half_mapped_room,
    looking,
    make_map,
    room,
)
from tests.mapping.pipeline.test_retrieval_only import bare  # noqa: F401

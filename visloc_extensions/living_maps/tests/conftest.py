"""Fixtures of the core's tests."""

from tests.mapping.conftest import (  # noqa: F401
    build_sample,
    build_walk,
    localization_errors,
    rewrite,
    sfm_walk,
    walk,
)
from tests.mapping.own_test.test_verdict import broken  # noqa: F401
from tests.mapping.pipeline.test_build_ready_made import described, found  # noqa: F401
from tests.mapping.pipeline.test_retrieval_only import bare  # noqa: F401
from tests.mapping.pipeline.test_turned_photos import orientations, turned_sample  # noqa: F401

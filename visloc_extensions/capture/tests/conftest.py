"""Fixtures of the core's tests."""

from tests.mapping.importers.test_scans import seen  # noqa: F401

from tests.mapping.conftest import build_sample  # noqa: F401
from tests.mapping.films.conftest import make_video  # noqa: F401

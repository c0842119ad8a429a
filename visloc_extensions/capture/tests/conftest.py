"""Fixtures of the core's tests."""

from tests.mapping.conftest import build_sample  # noqa: F401
from tests.mapping.importers.conftest import make_video  # noqa: F401

"""Fixtures of the core's tests."""

from tests.mapping.importers.conftest import make_video  # noqa: F401

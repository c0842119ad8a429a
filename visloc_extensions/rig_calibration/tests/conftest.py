"""Fixtures of the core's tests."""

from tests.mapping.cli.test_mapping_cli import run  # noqa: F401
from tests.mapping.conftest import build_walk, rewrite, sfm_walk, walk, walk_copy  # noqa: F401

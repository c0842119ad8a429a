"""Fixtures of the core's tests."""

from tests.mapping.conftest import bucket, sfm_walk, walk  # noqa: F401
from tests.service.conftest import in_study, serve, site, study  # noqa: F401
from tests.service.test_replicas import hall  # noqa: F401
from tests.visloc.archive.test_sets import incoming, made, store  # noqa: F401

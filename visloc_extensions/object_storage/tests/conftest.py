"""Fixtures of the core's tests."""

from tests.mapping.conftest import bucket, sfm_walk, walk  # noqa: F401
from tests.service.conftest import in_study, serve, study, two_rooms  # noqa: F401
from tests.service.test_replicas import hall  # noqa: F401
from visloc_extensions.sets.tests.conftest import site  # noqa: F401
from visloc_extensions.sets.tests.test_files import incoming, made, store  # noqa: F401

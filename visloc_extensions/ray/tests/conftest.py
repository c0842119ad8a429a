"""A dataset of a walk, its maps and object storage."""

from tests.mapping.conftest import bucket, rgbd_walk, sfm_walk, walk  # noqa: F401

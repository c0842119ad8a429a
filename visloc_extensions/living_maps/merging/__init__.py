"""``mapping merge``: two maps that overlap become one map, or a set of both."""

from visloc_extensions.living_maps.merging.job import Merged, join_as_set, merge_maps
from visloc_extensions.living_maps.merging.registration import Registration, register

__all__ = ["Merged", "Registration", "join_as_set", "merge_maps", "register"]

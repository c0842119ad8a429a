"""``mapping merge``: two maps that overlap become one map, or a set of both."""

from mapping.maps.merging.job import Merged, join_as_set, merge_maps
from mapping.maps.merging.registration import Registration, register

__all__ = ["Merged", "Registration", "join_as_set", "merge_maps", "register"]

"""`mapping update`: a new capture joins a map that exists."""

from __future__ import annotations

from visloc_extensions.living_maps.updating.job import update_map
from visloc_extensions.living_maps.updating.settings import UpdateSettings

__all__ = ["UpdateSettings", "update_map"]

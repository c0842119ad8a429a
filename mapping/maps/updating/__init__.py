"""`mapping update`: a new capture joins a map that exists."""

from __future__ import annotations

from mapping.maps.updating.job import update_map
from mapping.maps.updating.settings import UpdateSettings

__all__ = ["UpdateSettings", "update_map"]

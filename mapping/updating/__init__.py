"""`mapping update`: a new capture joins a map that exists."""

from __future__ import annotations

from mapping.updating.job import update_map
from mapping.updating.settings import UpdateSettings

__all__ = ["UpdateSettings", "update_map"]

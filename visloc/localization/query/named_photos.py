"""The mapping photos that a caller names instead of retrieving them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.errors import refuse

# So many unknown names, and so much of each, are told.
_MAX_NAMES, _MAX_NAME = 3, 100


class NamedPhotos:
    """Finds the photos of a map by name; the table is made for the first caller who names one."""

    def __init__(self, opened: Map) -> None:
        self._map = opened

    def rows(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the photos' rows (k,) in the map."""
        for name in names:
            if name not in self._row_of:
                got = f"{name}, which map {self._map.ref} does not have"
                raise refuse("options.photos", field="options.photos", got=got)
        return np.array([self._row_of[name] for name in names], dtype=np.int64)

    def check_matched(self, names: Iterable[str]) -> None:
        """Check names of photos that matches were sent with."""
        unknown = [name for name in names if name not in self._row_of]
        if unknown:
            shown = ", ".join(name[:_MAX_NAME] for name in unknown[:_MAX_NAMES])
            more = f" and {len(unknown) - _MAX_NAMES} more" if len(unknown) > _MAX_NAMES else ""
            raise refuse(
                "features.matches",
                field=f"features.matches.{unknown[0][:_MAX_NAME]}",
                expected=f"names of photos of map {self._map.ref}",
                got=f"{shown}{more}, which it does not have",
            )

    @cached_property
    def _row_of(self) -> Mapping[str, int]:
        return {image.name: row for row, image in enumerate(self._map.images)}

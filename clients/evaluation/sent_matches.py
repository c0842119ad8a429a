"""Matches of photos with mapping photos that another program found, as they are sent."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.kapture.matches import MatchFiles

KeypointsOf = Callable[[str], NDArray[np.float32]]
"""Takes the name of a mapping photo. Returns its keypoints (n, 2) in pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoMatches:
    """Matches in kapture's layout, of photos and mapping photos with features of one type.

    Attributes:
        pairs: names of the mapping photos by the photo's name.
    """

    files: MatchFiles
    pairs: Mapping[str, tuple[str, ...]]

    def of(self, name: str, keypoints_of: KeypointsOf) -> dict[str, NDArray[np.float32]]:
        """Return the matches (k, 3) of a photo by mapping photo: a row, and x, y of the other.

        A pair without a file has no match.
        """
        return {photo: self._of(name, photo, keypoints_of) for photo in self.pairs.get(name, ())}

    def _of(self, name: str, photo: str, keypoints_of: KeypointsOf) -> NDArray[np.float32]:
        rows = self.files.read(name, photo)
        if rows is None or not len(rows):
            return np.empty((0, 3), np.float32)
        keypoints, last = keypoints_of(photo), int(rows[:, 1].max())
        if last >= len(keypoints):
            got = f"row {last} of the {len(keypoints)} keypoints of {photo}"
            raise refuse("kapture.match_values", field=f"{name}, {photo}", got=got)
        return np.column_stack([rows[:, 0], keypoints[rows[:, 1]]]).astype(np.float32)

"""The photo, very small, as a global descriptor."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.features import Fingerprint, GlobalDescriptor, ImageDescriptor
from visloc.options import Inference

_SIDE_PX = 12


def load_thumbnail(
    _weights_dir: Path | None, _inference: Inference, _threads: int | None
) -> GlobalDescriptor:
    """Make the descriptor."""
    return Thumbnail()


class Thumbnail(ImageDescriptor):
    """The colours of a 12 x 12 picture; the base class learns a whitening for it on each map."""

    @property
    def fingerprint(self) -> Fingerprint:
        """Raise the revision whenever other vectors come out."""
        return Fingerprint("example-thumbnail", revision=1, parameters={"side_px": _SIDE_PX})

    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return (432,) of unit length; zeros for a photo of one colour."""
        small = cv2.resize(rgb, (_SIDE_PX, _SIDE_PX), interpolation=cv2.INTER_AREA)
        colours = small.astype(np.float32)
        colours -= colours.mean(axis=(0, 1))
        length = np.linalg.norm(colours)
        vector: NDArray[np.float32] = colours.ravel() / length if length > 0 else colours.ravel()
        return vector

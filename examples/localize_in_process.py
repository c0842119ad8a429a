"""Localize a photo in process, without a server.

python examples/localize_in_process.py MAPS_DIR MAP PHOTO [MODEL,W,H,PARAMS...]

Maps of features with weights of their own, such as r2d2, find them in the folder that
VISLOC_WEIGHTS_DIR names.
"""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path

from visloc import Camera
from visloc.archive import MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.images import read_photo_file
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.types import Localized


def main(maps_dir: str, map_ref: str, photo_path: str, camera: str | None = None) -> None:
    """Print where the photo was taken, or why that is not known."""
    opened = MapStore(Path(maps_dir)).open(map_ref)
    folder = os.environ.get("VISLOC_WEIGHTS_DIR")
    weights_dir = Path(folder) if folder else None
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(
        opened,
        make_local_features(name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    answer = localizer.localize(
        read_photo_file(Path(photo_path)),
        Camera.from_text(camera) if camera else None,
        LocalizeOptions(),
    )
    if isinstance(answer, Localized):
        x, y, z = answer.cam_from_world.center
        sys.stdout.write(f"at {x:.3f} {y:.3f} {z:.3f}, {answer.evidence.num_inliers} inliers\n")
    else:
        sys.stdout.write(f"not localized: {answer.message} ({answer.stage})\n")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Localize a photo without a server.

python examples/localize_in_process.py maps/kitchen/VERSION photo.jpg PINHOLE,640,480,525,...
"""

from __future__ import annotations

import sys
from pathlib import Path

from visloc import Camera
from visloc.archive import open_map
from visloc.features import make_local_features
from visloc.images import read_photo_file
from visloc.localizer import Localizer
from visloc.types import Localized, LocalizeOptions


def main(map_folder: str, photo_path: str, camera: str | None = None) -> None:
    """Print where the photo was taken, or why that is not known."""
    opened = open_map(Path(map_folder))
    extractor = make_local_features(opened.manifest.local_features.fingerprint.name)
    localizer = Localizer(opened, extractor)
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

"""Ask maps about queries with more and with fewer pixels than the mapping photos.

Each row is a map and a size: photos, answers, right ones, and in the median inliers, error, stated
deviation and seconds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

from benchmarks.trust.maps import Places
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo, read_photo_file
from visloc.types import Localized

# An answer is right within half a unit and five degrees, as in docs/trust.md.
RIGHT_UNITS, RIGHT_DEG = 0.5, 5.0


@dataclass(frozen=True, slots=True)
class Row:
    """One query: whether it was right, its error, the stated deviation, inliers and seconds."""

    answered: bool
    right: bool
    error: float
    std: float
    inliers: int
    seconds: float


def resized(photo: Photo, camera: Camera, times: float) -> tuple[Photo, Camera]:
    """Return a photo with so many times the pixels in width and height, and its camera."""
    width, height = round(photo.width * times), round(photo.height * times)
    if times == 1.0:
        return photo, camera
    method = cv2.INTER_AREA if times < 1.0 else cv2.INTER_CUBIC
    rgb = cv2.resize(photo.rgb, (width, height), interpolation=method)
    return replace(photo, rgb=np.asarray(rgb, np.uint8)), camera.scaled(width, height)


def ask(
    localizer: Localizer, places: Places, map_id: str, times: float, every: int, known: bool
) -> Iterator[Row]:
    """Ask a map about every so-manieth query, resized, with or without its camera."""
    dataset = read_dataset(places.dataset(map_id, "query"))
    for record in dataset.images[::every]:
        camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert truth is not None
        photo, own = resized(read_photo_file(dataset.path_of(record)), camera, times)
        began = perf_counter()
        answer = localizer.localize(photo, own if known else None, LocalizeOptions())
        yield row_of(answer, truth, perf_counter() - began)


def row_of(answer: object, truth: Pose, seconds: float) -> Row:
    """Compare an answer with the truth."""
    if not isinstance(answer, Localized):
        return Row(False, False, np.nan, np.nan, 0, seconds)
    units, degrees = pose_error(answer.cam_from_world, truth)
    right = units <= RIGHT_UNITS and degrees <= RIGHT_DEG
    std = float(np.linalg.norm(answer.position_std))
    return Row(True, right, units, std, answer.evidence.num_inliers, seconds)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--maps", type=Path, required=True, help="built by `make trust`")
    parser.add_argument("--only", default="redkitchen,castle,kitti_curve,gardenspoint,sample")
    parser.add_argument("--sizes", default="0.5,1,2,4,6")
    parser.add_argument("--every", type=int, default=1, help="ask every so-manieth query")
    parser.add_argument("--without-camera", action="store_true")
    chosen = parser.parse_args()
    places = Places(chosen.data, chosen.maps)
    write("| map | size | photos | answered | right | inliers | error | deviation | seconds |")
    write("|---|---|---|---|---|---|---|---|---|")
    for map_id in chosen.only.split(","):
        opened = places.store.open(map_id)
        extractor = make_local_features(opened.manifest.local_features.fingerprint.name)
        localizer = Localizer(opened, extractor)
        localizer.warm_up()
        for times in map(float, chosen.sizes.split(",")):
            known = not chosen.without_camera
            rows = list(ask(localizer, places, map_id, times, chosen.every, known))
            write(_line(map_id, times, rows))


def write(line: str) -> None:
    """Write a line at once: a size of one map can take minutes."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _line(map_id: str, times: float, rows: list[Row]) -> str:
    found = [row for row in rows if row.answered]
    median = [
        np.median([getattr(row, name) for row in found]) if found else np.nan
        for name in ("inliers", "error", "std")
    ]
    seconds = np.median([row.seconds for row in rows])
    right = sum(row.right for row in rows)
    return (
        f"| {map_id} | x{times:g} | {len(rows)} | {len(found)} | {right} | {median[0]:.0f} "
        f"| {median[1]:.4f} | {median[2]:.4f} | {seconds:.3f} |"
    )


if __name__ == "__main__":
    main()

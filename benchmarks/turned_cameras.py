"""Ask maps about queries of cameras that are held turned, without EXIF, and about other places.

The turned camera is exact: it is the query's, rolled about its optical axis. Rolls that are no
quarter turns are cut to a square that all rolls show, and so is the upright photo to compare with
(0c). Each row is a map, whose photos, and a turn: photos, answers, right ones, inliers and error in
the median, and seconds in the mean.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

from benchmarks.photo_sizes import Row, row_of, write
from benchmarks.trust.maps import Places
from visloc.features import make_local_features
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions, ReadAs
from visloc.photos.reading import Photo, read_photo_file

# Side of the square, as a share of the photo's shorter side: it lies in the photo at any roll.
_SQUARE = 0.7


def rolled(photo: Photo, camera: Camera, degrees: int, *, cut: bool) -> tuple[Photo, Camera, Pose]:
    """Return what the camera shows when its picture is turned clockwise, without distortion.

    Returns:
        The photo, its camera, and ``rolled_from_camera``.
    """
    named = dict(zip(CAMERA_MODELS[camera.model], camera.params, strict=True))
    fx, fy = named.get("fx", camera.focal_length), named.get("fy", camera.focal_length)
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    size = np.array([photo.width, photo.height])
    if cut:
        side = int(size.min() * _SQUARE)
        width, height = side, side
    else:
        width, height = size if degrees % 180 == 0 else size[::-1]
    principal = np.array([named["cx"], named["cy"]])
    centre = np.array([width, height]) / 2
    if not cut:
        centre = centre + turn @ (principal - size / 2)
    # OpenCV counts pixels from the centre of the first one, we from its corner.
    affine = np.column_stack([turn, turn @ (0.5 - principal) + centre - 0.5])
    rgb = cv2.warpAffine(photo.rgb, affine, (int(width), int(height)), flags=cv2.INTER_LINEAR)
    # The cameras asked have nearly equal focal lengths in x and y.
    focal = (fx, fy) if degrees % 180 == 0 else (fy, fx)
    params = (*focal, *centre.tolist())
    rotation = np.eye(3)
    rotation[:2, :2] = turn
    held = Camera("PINHOLE", int(width), int(height), params)
    return Photo(np.asarray(rgb, np.uint8)), held, Pose(rotation, np.zeros(3))


def ask(
    localizer: Localizer, folder: Path, turn: str, every: int, options: LocalizeOptions
) -> Iterator[Row]:
    """Ask about every so-manieth photo of a dataset, of a camera held so."""
    dataset = read_dataset(folder)
    for record in dataset.images[::every]:
        camera, truth = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert truth is not None
        photo = read_photo_file(dataset.path_of(record))
        degrees = int(turn.removesuffix("c"))
        held, own, held_from_camera = rolled(photo, camera, degrees, cut=turn.endswith("c"))
        began = perf_counter()
        answer = localizer.localize(held, own, options)
        yield row_of(answer, held_from_camera @ truth, perf_counter() - began)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--maps", type=Path, required=True, help="built by `make trust`")
    parser.add_argument("--only", default="redkitchen,castle,gardenspoint,sample")
    parser.add_argument("--of", help="the place of the photos, if not the map's own")
    parser.add_argument("--turns", default="0,90,180,270,0c,30c,45c,60c")
    parser.add_argument("--every", type=int, default=1, help="ask every so-manieth query")
    parser.add_argument("--read-as", type=ReadAs, default=ReadAs.ANY)
    chosen = parser.parse_args()
    places, options = Places(chosen.data, chosen.maps), LocalizeOptions(read_as=chosen.read_as)
    write("| map | photos of | turn | photos | answered | right | inliers | error | seconds |")
    write("|---|---|---|---|---|---|---|---|---|")
    for map_id in chosen.only.split(","):
        opened = places.store.open(map_id)
        extractor = make_local_features(opened.manifest.local_features.fingerprint.name)
        localizer = Localizer(opened, extractor)
        localizer.warm_up()
        folder = places.dataset(chosen.of or map_id, "query")
        for turn in chosen.turns.split(","):
            rows = list(ask(localizer, folder, turn, chosen.every, options))
            write(_line(map_id, chosen.of or map_id, turn, rows))


def _line(map_id: str, of: str, turn: str, rows: list[Row]) -> str:
    found = [row for row in rows if row.answered]
    inliers = np.median([row.inliers for row in found]) if found else 0
    error = np.median([row.error for row in found]) if found else np.nan
    seconds, right = np.mean([row.seconds for row in rows]), sum(row.right for row in rows)
    return (
        f"| {map_id} | {of} | {turn} | {len(rows)} | {len(found)} | {right} | {inliers:.0f} "
        f"| {error:.4f} | {seconds:.3f} |"
    )


if __name__ == "__main__":
    main()

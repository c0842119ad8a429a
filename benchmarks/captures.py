"""Maps by `mapping capture`, against poses that are known.

    python -m benchmarks.captures walk hallway drone --data ../shared/data

``walk``: a film of a walk through the sample world, with 1 % noise and slight blur; queries of the
sample after a rigid alignment, the size from one given length. ``hallway``: 51 photos of ie_tower
in order as a film; the given poses of 22 of them. ``drone``: the photos of drone_beach; queries
against their own EXIF positions. Films and maps are kept in --work. Prints one line for each.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.special import chdtri

from mapping.frames.anchor import align_poses
from mapping.importers import read_model
from mapping.sample import write_sample
from samples.film import encode_video, film_walk
from samples.scene import make_room
from samples.trajectories import mapping_trajectory, stereo_rig
from visloc.archive import Anchor, Map, MapStore
from visloc.evaluation import pose_error
from visloc.geodesy import enu_from_geodetic
from visloc.geometry import Pose, Similarity
from visloc.geopose import earth_covariance
from visloc.in_process import LocalMap, open_map
from visloc.kapture import read_dataset
from visloc.photos.reading import read_photo_file
from visloc.types import Localized

WALK_RATE, HALLWAY_RATE = 10, 5
WALK_FRAMES, WALK_PHOTOS = 300, 90
HALLWAY = "lookalike/query/sensors/records_data/floor11"


def capture(work: Path, map_id: str, *arguments: str) -> LocalMap:
    """Make the map, unless it is there; a run that was killed goes on."""
    maps = work / "maps"
    if map_id not in MapStore(maps).ids():
        subprocess.run(
            [
                *(sys.executable, "-m", "mapping.cli.main", "capture", *arguments),
                *("--map", map_id, "--maps-dir", str(maps)),
                *("--output", str(work / f"{map_id}.png"), "--accept"),
            ],
            check=True,
        )
    return open_map(map_id, maps)


def frame_poses(opened: Map, rate: int) -> dict[int, Pose]:
    """The map's poses by number of the frame, from the seconds in the photos' names."""
    return {
        round(rate * float(Path(image.name).name.removesuffix("s.jpg"))): Pose.from_quaternion(
            row[:4], row[4:]
        )
        for image, row in zip(opened.images, opened.image_poses, strict=True)
    }


def aligned(found: dict[int, Pose], known: dict[int, Pose]) -> tuple[Similarity, list[int]]:
    """The similarity to the known poses, over the frames that have both."""
    both = sorted(found.keys() & known.keys())
    return align_poses([found[i] for i in both], [known[i] for i in both]), both


def walk(work: Path, _: Path) -> str:
    """Queries of the sample in the map of a film."""
    rig = stereo_rig(640, 480)["left"]
    poses = [rig.cam_from_rig @ pose for pose in mapping_trajectory(WALK_FRAMES)]
    film = work / "walk.mp4"
    if not film.exists():
        film_walk(film, make_room(0), rig.camera, poses, rate=WALK_RATE)
    first, last = WALK_RATE, 11 * WALK_RATE
    length = float(np.linalg.norm(poses[first].center - poses[last].center))
    scale = ("--scale", "walk.mp4@1", "walk.mp4@11", f"{length:.4f}m")
    opened = capture(work, "walk", str(film), "--photos", str(WALK_PHOTOS), *scale)
    found = frame_poses(opened.archive, WALK_RATE)
    similarity, both = aligned(found, dict(enumerate(poses)))
    mean = np.mean([found[i].center for i in both], axis=0)
    target = np.mean([poses[i].center for i in both], axis=0)
    rigid = Similarity(1.0, similarity.rotation, target - similarity.rotation @ mean)
    sample = work / "sample"
    if not sample.exists():
        write_sample(sample)
    results = opened.localize_folder(sample / "query")
    errors = [
        pose_error(rigid.move(each.pose), each.truth)
        for each in results
        if each.pose is not None and each.truth is not None
    ]
    metres, degrees = np.array(errors).T
    return (
        f"walk: {len(found)} photos in the map, its size off by {similarity.scale - 1:+.2%}; "
        f"{len(errors)} of {len(results)} queries, median {100 * np.median(metres):.2f} cm, "
        f"{np.median(degrees):.3f} deg, worst {100 * metres.max():.2f} cm"
    )


def hallway(work: Path, data: Path) -> str:
    """Known poses of a hallway against those of the map of its film."""
    photos = sorted((data / "ie_tower" / HALLWAY).glob("f11_hallway_right*.jpg"))
    film = work / "hallway.mp4"
    if not film.exists():
        encode_video(film, (read_photo_file(path).rgb for path in photos), rate=HALLWAY_RATE)
    opened = capture(work, "hallway", str(film))
    found = frame_poses(opened.archive, HALLWAY_RATE)
    given = read_dataset(data / "ie_tower" / "floor11_hallway_right" / "mapping")
    number = {path.name: i for i, path in enumerate(photos)}
    known = {
        number[Path(record.path).name]: pose
        for record in given.images
        if (pose := given.pose(record)) is not None
    }
    similarity, both = aligned(found, known)
    errors = [
        float(np.linalg.norm(similarity.apply(found[i].center) - known[i].center)) for i in both
    ]
    frames = sorted(known)
    step = np.median(
        [np.linalg.norm(known[a].center - known[b].center) / (b - a) for a, b in pairwise(frames)]
    )
    return (
        f"hallway: {len(found)} of {len(photos)} photos in the map; {len(both)} of {len(known)} "
        f"known poses, median error {np.median(errors) / step:.2f} of the step between photos "
        f"(worst {max(errors) / step:.2f})"
    )


def drone(work: Path, data: Path) -> str:
    """Photos of a drone against the positions that it noted."""
    opened = capture(work, "drone", str(data / "drone_beach" / "mapping"))
    anchor = opened.archive.manifest.world.anchor
    assert anchor is not None
    assert anchor.geodetic is not None
    place = anchor.geodetic
    origin = np.array([place.latitude_deg, place.longitude_deg, place.altitude_m])
    folder = data / "drone_beach" / "query"
    queries = read_model("images", folder)
    fixes = {fix.timestamp: np.array([fix.y, fix.x, fix.z]) for fix in queries.gnss}
    lines = []
    for image in queries.images:
        answer = opened.localize(folder / image.name).answer
        if not isinstance(answer, Localized):
            lines.append(f"{image.name} refused")
            continue
        error = (
            answer.cam_from_world.center
            - enu_from_geodetic(fixes[image.timestamp][None], origin)[0]
        )
        lines.append(f"{image.name} {_offset(error, answer, anchor)}")
    return "drone: " + "; ".join(lines)


def _offset(error: NDArray[np.float64], answer: Localized, anchor: Anchor) -> str:
    """How far off a position is, and whether what is stated of it on Earth covers it."""
    stated = earth_covariance(answer.cam_from_world, answer.covariance, anchor)
    covered = "inside" if error @ np.linalg.solve(stated, error) <= chdtri(3, 0.05) else "outside"
    east, north, up = np.sqrt(np.diag(stated))
    return (
        f"{error[2]:+.2f} m in height, {math.hypot(*error[:2]):.2f} m level, {covered} the stated "
        f"95 % (standard deviations {east:.2f}, {north:.2f}, {up:.2f} m)"
    )


ROWS: dict[str, Callable[[Path, Path], str]] = {"walk": walk, "hallway": hallway, "drone": drone}


def main(
    rows: Annotated[list[str], typer.Argument(help=f"Of {', '.join(ROWS)}.")],
    data: Annotated[Path, typer.Option(help="Folder of ie_tower and drone_beach.")] = Path(
        "../shared/data"
    ),
    work: Annotated[Path, typer.Option(help="Folder for films and maps.")] = Path(".captures"),
) -> None:
    """Make maps of films and photos with one command each, and measure them."""
    work.mkdir(parents=True, exist_ok=True)
    for row in rows:
        typer.echo(ROWS[row](work, data))


if __name__ == "__main__":
    typer.run(main)

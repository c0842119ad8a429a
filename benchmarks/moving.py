"""Maps of the painted room in which something moves, built as users build them.

    python -m benchmarks.moving none ahead:0.4 crossing:0.2

``ahead:WIDTH`` puts a poster of so many metres before the camera, which moves along with it as a
bonnet does; ``crossing:WIDTH`` one that walks through the room. No masks are given. Prints how much
of the photos it covers, how far off the poses are, what the build noted, and what the map's own
test says. With ``--poses given`` the build knows the true poses.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import cv2
import numpy as np
import typer

from mapping.frames.anchor import align_poses
from mapping.importers import ImportedModel, write_imported
from mapping.importers.model import ImportedImage
from samples.render import render_photo
from samples.scene import Rectangle, Scene, make_room
from samples.trajectories import mapping_trajectory, stereo_rig
from visloc.archive import Map, MapStore
from visloc.geometry import Pose
from visloc.kapture import Sensor
from visloc.localization.map_view.constraints import MapGeometry

NUM_PHOTOS, SIZE = 24, (320, 240)
HEIGHT_M, AHEAD_M, ASIDE_M = 1.7, 1.5, 0.25
# The path of what walks through the room: an ellipse, walked so often.
HALF_AXES_M, ROUNDS = (1.2, 0.9), 1.7
POSTER_SEED = 5
OPTIONS = [
    "--method=sfm",
    "--pairs=exhaustive",
    "--local-features=sift",
    "--global-features=localvlad",
    "--max-keypoints=1000",
    "--workers=1",
]


@cache
def painted() -> Rectangle:
    """The wall of another room, whose paint the moving thing has."""
    return max(make_room(POSTER_SEED).rectangles, key=lambda each: each.levels[0].size)


def poster_before(pose: Pose, number: int, how: str, width: float) -> Rectangle:
    """The moving thing as it is when a photo is taken from ``pose`` (cam_from_world)."""
    right, down, ahead = pose.rotation
    if how == "ahead":
        middle = pose.center + AHEAD_M * ahead + ASIDE_M * right
        along, upright = right, down
    else:
        angle = 2 * np.pi * ROUNDS * number / NUM_PHOTOS
        middle = np.array([HALF_AXES_M[0] * np.cos(angle), HALF_AXES_M[1] * np.sin(angle), 1.0])
        seen = (middle - pose.center) * (1, 1, 0)
        upright = np.array([0.0, 0.0, -1.0])
        along = np.cross(upright, seen / np.linalg.norm(seen))
    u, v = width * along, HEIGHT_M * upright
    return Rectangle(middle - u / 2 - v / 2, u, v, painted().levels)


def write_photos(folder: Path, what: str, poses: list[Pose]) -> float:
    """Write a photo from each pose, and return how much of them the moving thing covers."""
    camera, room = stereo_rig(*SIZE)["left"].camera, make_room(0)
    how, _, width = what.partition(":")
    folder.mkdir()
    covered = []
    for number, pose in enumerate(poses):
        still = photo = render_photo(room, camera, pose)
        if how != "none":
            poster = poster_before(pose, number, how, float(width))
            photo = render_photo(Scene((*room.rectangles, poster)), camera, pose)
        covered.append(float((photo != still).any(axis=-1).mean()))
        cv2.imwrite(str(folder / f"{number:02}.png"), photo[..., ::-1])
    return float(np.mean(covered))


def built(folder: Path, poses: list[Pose], given: str) -> Map | None:
    """Build a map of the photos in a folder; None when nothing was published."""
    images = tuple(
        ImportedImage(f"{number:02}.png", "cam", number, pose if given == "given" else None)
        for number, pose in enumerate(poses)
    )
    camera = Sensor.with_camera("cam", stereo_rig(*SIZE)["left"].camera)
    write_imported(ImportedModel({"cam": camera}, images, folder / "photos"), folder / "dataset")
    command = [sys.executable, "-c", "from mapping.cli.main import main; main()", "build"]
    command += [str(folder / "dataset"), "--map=moving", f"--maps-dir={folder / 'maps'}"]
    done = subprocess.run(
        [*command, *OPTIONS, f"--poses={given}"], capture_output=True, text=True, check=False
    )
    store = MapStore(folder / "maps")
    if "moving" not in store.ids() and not store.versions("moving"):
        typer.echo(done.stderr[-500:])
        return None
    return store.open(f"moving@{store.versions('moving')[-1]}")


def told(opened: Map, true: list[Pose]) -> str:
    """Say how far off the poses of a map are, and what the map tells of itself."""
    viewpoints = MapGeometry(opened).viewpoints
    found = [viewpoints.pose(row) for row in range(len(opened.images))]
    true = [true[int(Path(image.name).stem)] for image in opened.images]
    moved = align_poses(found, true)
    centers = np.array([pose.center for pose in true])
    off = np.linalg.norm(moved.apply(np.array([pose.center for pose in found])) - centers, axis=1)
    parts = opened.manifest.parts
    return "\n".join(
        (
            f"{len(found)} of {NUM_PHOTOS} photos placed, rms {100 * np.sqrt(np.mean(off**2)):.1f} "
            f"cm, largest {100 * off.max():.1f} cm",
            *(f"  note: {note}" for note in opened.manifest.notes),
            *(f"  doubt {doubt.kind}: {doubt.message}" for doubt in parts.doubts),
            f"  own test: {parts.own_test}",
        )
    )


def main(
    moving: Annotated[list[str], typer.Argument(help="none, ahead:WIDTH, crossing:WIDTH (metres)")],
    poses: Annotated[str, typer.Option(help="estimate, or given: the true ones.")] = "estimate",
) -> None:
    """Build maps of photos in which something moves, and compare them with the true poses."""
    mounted = stereo_rig(*SIZE)["left"].cam_from_rig
    true = [mounted @ pose for pose in mapping_trajectory(NUM_PHOTOS)]
    for what in moving:
        with TemporaryDirectory() as folder:
            covered = write_photos(Path(folder) / "photos", what, true)
            opened = built(Path(folder), true, poses)
            said = "no map" if opened is None else told(opened, true)
        typer.echo(f"{what} covers {covered:.0%}: {said}")


if __name__ == "__main__":
    typer.run(main)

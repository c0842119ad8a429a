"""Poses from photos of the painted room in which something moves, compared with the true ones.

    python -m benchmarks.moving none ahead:0.4 crossing:0.2

``ahead:WIDTH`` puts a poster of so many metres before the camera, which moves along with it as a
bonnet or a person who walks ahead does; ``crossing:WIDTH`` one that walks through the room. No
masks are used. Prints how much of the photos it covers, and how far off the poses are.
"""

from __future__ import annotations

import tempfile
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mapping.frames.anchor import align_poses
from mapping.methods.matching import Matches
from mapping.methods.sparse_model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.two_views import fits_two_views
from mapping.methods.undoing import reconstruct_places
from samples.render import render_photo
from samples.scene import Rectangle, Scene, make_room
from samples.trajectories import mapping_trajectory, stereo_rig
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import round_descriptors
from visloc.types import LocalFeatures

NUM_PHOTOS, SIZE, MAX_KEYPOINTS = 24, (320, 240), 1000
HEIGHT_M, AHEAD_M, ASIDE_M = 1.7, 1.5, 0.25
# The path of what walks through the room: an ellipse, walked so often.
HALF_AXES_M, ROUNDS = (1.2, 0.9), 1.7
POSTER_SEED = 5
CONFIG = MAPPER_CONFIGS["config1"]


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
    paint = max(make_room(POSTER_SEED).rectangles, key=lambda each: each.levels[0].size)
    return Rectangle(middle - u / 2 - v / 2, u, v, paint.levels)


def matched(found: list[LocalFeatures]) -> tuple[list[SfmPhoto], list[Matches]]:
    """Photos, and all their pairs with verified matches."""
    camera = stereo_rig(*SIZE)["left"].camera
    photos = [
        SfmPhoto(f"{row}.jpg", "cam", row, camera, True, None, each.keypoints)
        for row, each in enumerate(found)
    ]
    looks = [round_descriptors(each.descriptors) for each in found]
    matches = []
    for a, b in combinations(range(len(photos)), 2):
        i, j, _ = mutual_nearest_neighbours(looks[a], looks[b])
        fits = fits_two_views(
            (camera, camera),
            photos[a].keypoints[i],
            photos[b].keypoints[j],
            CONFIG.filter_max_reproj_error,
            calibrated=True,
        )
        if fits.sum() >= CONFIG.min_num_matches:
            matches.append(Matches(a, b, np.column_stack([i, j]).astype(np.uint32)[fits]))
    return photos, matches


def told(what: str, model: SparseModel, poses: list[Pose], covered: float) -> str:
    """A line about one model."""
    rows = [row for row, view in enumerate(model.views) if view is not None]
    found = [view.cam_from_world for view in model.views if view is not None]
    true = [poses[row] for row in rows]
    moved = align_poses(found, true)
    centers = np.array([pose.center for pose in true])
    off = np.linalg.norm(moved.apply(np.array([pose.center for pose in found])) - centers, axis=1)
    return (
        f"{what} covers {covered:.0%}: {len(rows)} of {len(poses)} photos placed, "
        f"rms {100 * np.sqrt(np.mean(off**2)):.1f} cm, largest {100 * off.max():.1f} cm"
    )


def main(
    moving: Annotated[list[str], typer.Argument(help="none, ahead:WIDTH, crossing:WIDTH (metres)")],
) -> None:
    """Find poses of photos in which something moves, and compare them with the true ones."""
    rig = stereo_rig(*SIZE)["left"]
    poses = [rig.cam_from_rig @ pose for pose in mapping_trajectory(NUM_PHOTOS)]
    room, sift = make_room(0), make_local_features("sift", threads=1)
    for what in moving:
        how, _, width = what.partition(":")
        found, covered = [], []
        for number, pose in enumerate(poses):
            still = photo = render_photo(room, rig.camera, pose)
            if how != "none":
                poster = poster_before(pose, number, how, float(width))
                photo = render_photo(Scene((*room.rectangles, poster)), rig.camera, pose)
            covered.append(float((photo != still).any(axis=-1).mean()))
            found.append(sift.extract(photo, max_keypoints=MAX_KEYPOINTS))
        photos, matches = matched(found)
        looks = [np.rint(127 * each.descriptors).astype(np.int8) for each in found]
        with tempfile.TemporaryDirectory() as folder:
            model = reconstruct_places(
                photos, looks.__getitem__, {}, matches, CONFIG, (), Path(folder), lambda *_: None
            )
        typer.echo(told(what, model, poses, float(np.mean(covered))))


if __name__ == "__main__":
    typer.run(main)

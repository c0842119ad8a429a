"""What matching all landmarks that the first pose predicts visible would bring.

    python -m benchmarks.after_the_pose MAP QUERY [--weights-dir DIR] [--top-k 20]

MAP is a folder of a map's versions, QUERY a kapture dataset. Each photo is localized as always.
Then the landmarks of all photos of the map that looked in a similar direction are projected with
the pose found, and matched with the keypoints near by: mutual nearest neighbours within a window,
voted for as in ``visloc.matching.correspondences``, photos with the nearest viewpoint first. Two
ways of using them are shown: instead of the first matches, and only added to their inliers. The
product does neither (docs/decisions/0019). Prints a table in Markdown.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from visloc.archive import Map, MapStore
from visloc.evaluation import pose_error
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.query.feature_cache import FeatureCache
from visloc.matching.correspondences import Correspondences, settled
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.generalized import refine_generalized_pose
from visloc.pose.reprojection import MatchedView, project
from visloc.types import LocalFeatures, Localized

WINDOW_PX = 6.0
MAX_ANGLE_DEG = 60.0
MAX_PHOTOS = 40
MAX_ERROR_PX = 12.0
WAYS = ("the first pose", "matched again", "inliers and new matches")


def photos_by_viewpoint(opened: Map, cam_from_local: Pose, depth: float) -> NDArray[np.int64]:
    """Rows of the map's photos that look in a similar direction, the nearest viewpoint first."""
    poses = [Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses]
    centres = np.array([pose.inverse().translation for pose in poses])
    centres -= np.asarray(opened.manifest.world.origin)
    axes = np.array([pose.rotation[2] for pose in poses])
    cosines = np.clip(axes @ cam_from_local.rotation[2], -1, 1)
    angles = np.degrees(np.arccos(cosines))
    distances = np.linalg.norm(centres - cam_from_local.inverse().translation, axis=1)
    order = np.argsort(distances / depth + angles / 45.0, kind="stable")
    return np.asarray(order[angles[order] < MAX_ANGLE_DEG][:MAX_PHOTOS])


def matched_again(
    opened: Map, local: LocalFeatures, camera: Camera, cam_from_local: Pose, depth: float
) -> Correspondences:
    """Match the landmarks that the pose predicts visible with the keypoints near by."""
    tree = cKDTree(local.keypoints)
    proposals = [
        (*_in_window(opened, int(photo), local, camera, cam_from_local, tree), 1.0 / (rank + 1))
        for rank, photo in enumerate(photos_by_viewpoint(opened, cam_from_local, depth))
    ]
    keypoints, landmarks, similarities = (
        np.concatenate([proposal[part] for proposal in proposals]) for part in range(3)
    )
    votes = np.repeat([p[3] for p in proposals], [len(p[0]) for p in proposals])
    return settled(keypoints, landmarks, votes, similarities)


def _in_window(
    opened: Map,
    photo: int,
    local: LocalFeatures,
    camera: Camera,
    cam_from_local: Pose,
    tree: cKDTree,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    landmarks, rows = opened.observations(photo)
    pixels = project(camera, cam_from_local.apply(opened.landmarks[landmarks].astype(np.float64)))
    # NaN, behind the camera, is nowhere near.
    around = tree.query_ball_point(np.nan_to_num(pixels, nan=-1e6), WINDOW_PX)
    near: list[list[int]] = np.asarray(around).tolist()  # of many points, an array of lists
    counts = np.array([len(found) for found in near], dtype=np.int64)
    keypoints = np.array([k for found in near for k in found], dtype=np.int64)
    seen = np.repeat(np.arange(len(landmarks)), counts)
    scale = opened.manifest.local_features.descriptor_scale
    similarity = np.einsum(
        "nd,nd->n", local.descriptors[keypoints], rows[seen].astype(np.float32) * scale
    )
    best_of_keypoint = np.full(len(local), -np.inf, np.float32)
    best_of_landmark = np.full(len(landmarks), -np.inf, np.float32)
    np.maximum.at(best_of_keypoint, keypoints, similarity)
    np.maximum.at(best_of_landmark, seen, similarity)
    mutual = similarity == best_of_keypoint[keypoints]
    mutual &= similarity == best_of_landmark[seen]
    return keypoints[mutual], landmarks[seen[mutual]].astype(np.int64), similarity[mutual]


def measure(
    localizer: Localizer, query: Path, options: LocalizeOptions
) -> Iterator[tuple[list[tuple[float, float]], list[int], float]]:
    """Yield, of each photo that is localized, errors and inliers by way, and extra seconds."""
    opened, origin = localizer.map, localizer.geometry.origin
    dataset = read_dataset(query)
    for record in dataset.images:
        found: FeatureCache = {}
        photo = read_photo_file(dataset.path_of(record))
        look = localizer.look(photo, dataset.sensors[record.sensor_id].camera, options, cache=found)
        answer, inliers = localizer.solve_look(look, options)
        truth = dataset.pose(record)
        if not isinstance(answer, Localized) or truth is None:
            continue
        (features,) = found.values()
        camera = answer.evidence.camera
        first = answer.cam_from_world
        start = time.perf_counter()
        cam_from_local = Pose(first.rotation, first.translation + first.rotation @ origin)
        depth = float(np.median(cam_from_local.apply(look.matches.points[inliers])[:, 2]))
        again = matched_again(opened, features.local, camera, cam_from_local, depth)
        pixels = features.local.keypoints[again.keypoints].astype(np.float64)
        points = opened.landmarks[again.landmarks].astype(np.float64)
        old = {tuple(pixel) for pixel in look.matches.pixels[inliers].tolist()}
        new = np.array([tuple(pixel) not in old for pixel in pixels.tolist()], dtype=bool)
        new &= ~np.isin(again.landmarks, look.landmarks[inliers])
        views = (
            MatchedView(camera, Pose.identity(), pixels, points),
            MatchedView(
                camera,
                Pose.identity(),
                np.concatenate([look.matches.pixels[inliers], pixels[new]]),
                np.concatenate([look.matches.points[inliers], points[new]]),
            ),
        )
        errors, counts = [pose_error(first, truth)], [int(inliers.sum())]
        for view in views:
            refined = refine_generalized_pose([view], cam_from_local, max_error_px=MAX_ERROR_PX)
            assert refined is not None  # it starts at a pose with many inliers
            pose = refined.rig_from_world
            world = Pose(pose.rotation, pose.translation - pose.rotation @ origin)
            errors.append(pose_error(world, truth))
            counts.append(refined.num_inliers)
        yield errors, counts, time.perf_counter() - start


def main(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="A folder of map versions.")],
    query: Annotated[Path, typer.Argument(help="A kapture dataset.")],
    weights_dir: Path | None = None,
    top_k: int = 20,
) -> None:
    """Localize, match again, print."""
    opened = MapStore(map_folder.parent).open(map_folder.name)
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(
        opened,
        make_local_features(name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    photos = list(measure(localizer, query, LocalizeOptions(top_k=top_k)))
    if not photos:
        typer.echo("No photo with a true pose was localized: nothing to measure.", err=True)
        raise typer.Exit(1)
    typer.echo("| way | median | 90 % | worst | nearer than the first | inliers |")
    typer.echo("|---|---|---|---|---|---|")
    errors = np.array([of_photo for of_photo, _, _ in photos])
    counts = np.array([of_photo for _, of_photo, _ in photos])
    for way, title in enumerate(WAYS):
        metres, degrees = errors[:, way].T
        better = int(np.count_nonzero(metres < errors[:, 0, 0]))
        texts = [
            f"{measured(metres) * 100:.2f} cm, {measured(degrees):.3f} deg"
            for measured in (np.median, lambda values: np.percentile(values, 90), np.max)
        ]
        typer.echo(
            f"| {title} | {' | '.join(texts)} | {better} of {len(photos)} | "
            f"{np.median(counts[:, way]):.0f} |"
        )
    typer.echo(f"\n{np.median([seconds for _, _, seconds in photos]):.2f} s more for each photo.")


if __name__ == "__main__":
    typer.run(main)

"""Poses approximated by retrieval alone: EWB, BDI and CSI over k, beside kapture-localization's.

    python -m benchmarks.coarse MAP QUERY [--peer PYTHON] [--top-k 1,3,5,10,20] [--weights-dir DIR]

MAP is a folder of a map's versions, QUERY a kapture dataset. Both programs get the same retrieved
photos, global descriptors and poses. PYTHON is the interpreter of an environment that has
kapture-localization 1.1.10. The second table is of the coarse poses that the service states: how
far off they are, how far off they say that they are, and how often the ellipsoid of 95 % holds the
truth, of all photos and of those that are refused. Prints tables in Markdown.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.retrieval import whole_numbers
from visloc.archive import MapStore
from visloc.evaluation import CHI2_95_OF_3, calibration, pose_error
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.query.feature_cache import FeatureCache
from visloc.options import Fallback, LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.average import average_pose
from visloc.retrieval.interpolation import WEIGHTINGS, joined
from visloc.types import CoarsePose, Localized

_PEER = Path(__file__).with_name("coarse_peer.py")
_Errors = Mapping[tuple[str, int], list[tuple[float, float]]]


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """A photo with a true pose.

    Attributes:
        truth: cam_from_world.
        vector: (D,) its joined global descriptors.
        photos: (k,) rows of the map's photos, best first.
        coarse: what the service states of it.
        localized: whether it is localized.
    """

    truth: Pose
    vector: NDArray[np.float64]
    photos: NDArray[np.int64]
    coarse: CoarsePose | None
    localized: bool


def queries(
    localizer: Localizer, weights_dir: Path | None, root: Path, top_k: int
) -> Iterator[Query]:
    """Yield every photo of a dataset that has a pose."""
    opened, dataset = localizer.map, read_dataset(root)
    rows = {image.name: row for row, image in enumerate(opened.images)}
    options = LocalizeOptions(top_k=top_k, fallback=Fallback.COARSE)
    make = partial(make_global_descriptor, weights_dir=weights_dir)
    descriptors = {name: make(name) for name in opened.fusion.counted(opened.global_descriptors)}
    for record in dataset.images:
        truth = dataset.pose(record)
        if truth is None:
            continue
        found: FeatureCache = {}
        photo = read_photo_file(dataset.path_of(record))
        look = localizer.look(photo, dataset.sensors[record.sensor_id].camera, options, cache=found)
        answer, _ = localizer.solve_look(look, options)
        (features,) = found.values()
        described = {
            name: each.describe(features.rgb, features.local, opened.global_models[name])
            for name, each in descriptors.items()
        }
        photos = np.array([rows[each.name] for each in look.evidence.retrieved], np.int64)
        vector = joined(described, opened.fusion.weights)
        yield Query(truth, vector, photos, look.coarse, isinstance(answer, Localized))


def ours(localizer: Localizer, asked: Sequence[Query], top_k: Sequence[int]) -> _Errors:
    """Errors by method and k."""
    opened, errors = localizer.map, dict[tuple[str, int], list[tuple[float, float]]]()
    poses = [Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses]
    for query in asked:
        rows = joined(
            {name: opened.global_descriptors[name][query.photos] for name in _counted(localizer)},
            opened.fusion.weights,
        )
        taken = [poses[row] for row in query.photos]
        rotations = np.stack([pose.rotation for pose in taken])
        centers = np.stack([pose.center for pose in taken])
        for method, weigh in WEIGHTINGS.items():
            for k in top_k:
                found = average_pose(rotations[:k], centers[:k], weigh(query.vector, rows[:k]))
                errors.setdefault((method.value, k), []).append(pose_error(found, query.truth))
    return errors


def peers(
    python: Path, localizer: Localizer, asked: Sequence[Query], top_k: Sequence[int]
) -> _Errors:
    """Errors of kapture-localization by method and k, on the same photos."""
    opened, num = localizer.map, len(localizer.map.images)
    every = {name: opened.global_descriptors[name][np.arange(num)] for name in _counted(localizer)}
    with tempfile.TemporaryDirectory() as folder:
        given, told = Path(folder) / "given.npz", Path(folder) / "told.npy"
        np.savez(
            given,
            queries=np.stack([query.vector for query in asked]),
            photos=np.stack([query.photos for query in asked]),
            rows=joined(every, opened.fusion.weights),
            poses=opened.image_poses,
            top_k=np.array(top_k),
            methods=np.array([method.value for method in WEIGHTINGS]),
        )
        subprocess.run([python, _PEER, given, told], check=True)
        poses = np.load(told)
    return {
        (method.value, k): [
            pose_error(Pose.from_quaternion(row[:4], row[4:]), query.truth)
            for row, query in zip(poses[i, j], asked, strict=True)
        ]
        for i, method in enumerate(WEIGHTINGS)
        for j, k in enumerate(top_k)
    }


def print_spread(asked: Sequence[Query]) -> None:
    """Print how well the stated spread holds."""
    typer.echo(
        "\n| photos | number | median error | median stated | position held | rotation held |"
    )
    typer.echo("|---|---|---|---|---|---|")
    for title, which in (("all", asked), ("refused", [q for q in asked if not q.localized])):
        stated = [(q.coarse, q.truth) for q in which if q.coarse is not None]
        if not stated:
            continue
        errors = np.median([pose_error(c.cam_from_world, truth) for c, truth in stated], axis=0)
        stds = [
            (np.linalg.norm(c.position_std), np.degrees(np.linalg.norm(c.orientation_std)))
            for c, _ in stated
        ]
        std = np.median(stds, axis=0)
        position = calibration([(c.cam_from_world, c.covariance, truth) for c, truth in stated])
        assert position is not None  # there are some
        rotation = float(np.mean([_rotation_held(c, truth) for c, truth in stated]))
        typer.echo(
            f"| {title} | {len(stated)} | {errors[0]:.2f} m, {errors[1]:.1f}° | {std[0]:.2f} m, "
            f"{std[1]:.1f}° | {position.inside_95:.0%} | {rotation:.0%} |"
        )


def _rotation_held(coarse: CoarsePose, truth: Pose) -> bool:
    turned = Rotation.from_matrix(truth.rotation @ coarse.cam_from_world.rotation.T).as_rotvec()
    return float(turned @ np.linalg.solve(coarse.covariance[:3, :3], turned)) <= CHI2_95_OF_3


def _counted(localizer: Localizer) -> tuple[str, ...]:
    return localizer.map.fusion.counted(localizer.map.global_descriptors)


def main(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="A folder of map versions.")],
    query: Annotated[Path, typer.Argument(help="A kapture dataset.")],
    peer: Annotated[Path | None, typer.Option(help="Python with kapture-localization.")] = None,
    top_k: Annotated[str, typer.Option(help="Numbers of photos.")] = "1,3,5,10,20",
    weights_dir: Path | None = None,
) -> None:
    """Approximate, compare, print."""
    opened = MapStore(map_folder.parent).open(map_folder.name)
    localizer = Localizer(
        opened,
        make_local_features(opened.manifest.local_features.fingerprint.name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    numbers = whole_numbers(top_k)
    asked = list(queries(localizer, weights_dir, query, max(*numbers, 10)))
    programs = {"visloc": ours(localizer, asked, numbers)}
    if peer is not None:
        programs["kapture-localization"] = peers(peer, localizer, asked, numbers)
    typer.echo(f"| method | program | {' | '.join(f'k = {k}' for k in numbers)} |")
    typer.echo(f"|---|---|{'---|' * len(numbers)}")
    for method in WEIGHTINGS:
        for program, errors in programs.items():
            cells = [np.median(errors[method.value, k], axis=0) for k in numbers]
            text = " | ".join(f"{metres:.2f} m, {degrees:.1f}°" for metres, degrees in cells)
            typer.echo(f"| {method.value.upper()} | {program} | {text} |")
    print_spread(asked)


if __name__ == "__main__":
    typer.run(main)

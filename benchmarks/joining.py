"""Poses from photos alone: which photos come into one model, and how long that takes.

    python -m benchmarks.joining hallways DATA/ie_tower --floor floor11
    python -m benchmarks.joining walk DATA/gardenspoint/mapping
    python -m benchmarks.joining small
    python -m benchmarks.joining speed --images 500 [--code OTHER_VERSION]

``hallways`` puts the photos of both hallways of a floor into one folder. ``walk`` takes a dataset
whose photos were taken in order, and whose poses lie in pieces 1000 units apart. Both make all
models that a build makes: one of all photos, then one of those that are left, and so on. ``small``
compares the poses of few photos of the sample with the true ones, over settings that should not
matter. ``speed`` builds a map of photos of the sample in a process of its own, without its poses,
rigs and positions.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from mapping.cluster.executors import open_executor
from mapping.cluster.workers import one_thread_here
from mapping.frames.anchor import align_poses
from mapping.importers.dataset import write_imported
from mapping.importers.images import read as read_photos
from mapping.methods.matching.stages import (
    Matches,
    Verification,
    find_fixed,
    match_pairs,
    matches_among,
    outside_fixed,
)
from mapping.methods.pieces import models_beside
from mapping.methods.scenes import find_pairs, make_scene
from mapping.methods.sfm_settings import SfmSettings
from mapping.methods.sparse.extending import with_late_photos
from mapping.methods.sparse.look_alikes import without_look_alikes
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.undoing import reconstruct_places
from mapping.pairing import PairSettings
from mapping.sample import write_sample
from mapping.stages.context import BuildContext
from mapping.stages.global_features import describe_photos
from mapping.stages.local_features import local_features_source
from mapping.stages.networks import Networks
from mapping.stages.photos import collect_photos
from mapping.stages.work_folder import WorkFolder
from visloc.errors import InvalidInput
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES
from visloc.geometry import PixelOrigin, Pose
from visloc.kapture import read_dataset
from visloc.options import Inference

Model = dict[str, Pose]
CONFIG = MAPPER_CONFIGS["config1"]
# Of the poses of one dataset.
PIECES_APART = 1000.0
SETTINGS = SfmSettings(pairs=("retrieval", "sequence"), poses="estimate")
# Photos of the sample, their size, the seed, local features, keypoints, pairs of a photo.
SMALL = (
    (16, (256, 192), 0, "sift", 500, 4),
    (16, (256, 192), 0, "sift", 1000, 4),
    (16, (256, 192), 0, "sift", 1000, 8),
    (16, (256, 192), 1, "sift", 500, 4),
    (16, (256, 192), 1, "sift", 1000, 4),
    (24, (320, 240), 0, "sift", 500, 4),
    (24, (320, 240), 0, "sift", 1000, 4),
    (24, (320, 240), 0, "sift", 1000, 8),
    (24, (320, 240), 1, "sift", 1000, 4),
    (16, (512, 384), 0, "sift", 1000, 4),
    (16, (512, 384), 0, "sift", 2000, 4),
    (16, (512, 384), 0, "sift", 1000, 8),
    (16, (512, 384), 0, "xfeat", 1000, 4),
    (24, (320, 240), 0, "xfeat", 1000, 8),
)
# The command was in another file in versions before its rooms.
COMMAND = """
try:
    from mapping.cli.main import main
except ImportError:
    from mapping.cli import main
main()
"""
WorkOption = Annotated[Path, typer.Option(help="Features and matches, kept for the next run.")]
app = typer.Typer(add_completion=False, help=__doc__)


@dataclass(frozen=True, slots=True)
class Matched:
    """Photos with keypoints, their descriptors in 8 bits, and verified matches."""

    photos: list[SfmPhoto]
    looks: list[NDArray[np.int8]]
    matches: list[Matches]


def matched(
    root: Path,
    work: Path,
    settings: SfmSettings,
    *,
    local_features: str = DEFAULT_LOCAL_FEATURES,
    global_features: Sequence[str] = DEFAULT_GLOBAL_FEATURES,
    max_keypoints: int = 5000,
) -> Matched:
    """Return the inputs of incremental mapping of a dataset's photos."""
    networks = Networks(None, Inference.AUTO)
    dataset = read_dataset(root)
    with open_executor("local", 2, "") as workers, one_thread_here():
        folder = WorkFolder(work)
        source = local_features_source(
            folder,
            root,
            local_features,
            networks=networks,
            max_keypoints=max_keypoints,
            features_dir=None,
            pixel_origin=PixelOrigin.CORNER,
        )
        context = BuildContext(folder, source, networks, workers, lambda *_: None)
        photos, _ = collect_photos(dataset, posed=False, with_files=True, progress=lambda *_: None)
        context.run("local features", source.prepare, photos)
        described = [describe_photos(context, photos, name) for name in global_features]
        pairs = find_pairs(make_scene(dataset, photos, described, settings), settings)
        verification = Verification(CONFIG.filter_max_reproj_error, CONFIG.min_num_matches, False)
        fixed = find_fixed(context, photos, pairs.rows, verification)
        context = outside_fixed(context, photos, fixed)
        matches, _ = match_pairs(context, photos, pairs.rows, verification)
        found = [context.features.read(photo) for photo in photos]
        given = [
            SfmPhoto(
                photo.name,
                photo.record.sensor_id,
                photo.record.timestamp,
                photo.camera,
                photo.camera_known,
                None,
                features.keypoints,
            )
            for photo, features in zip(photos, found, strict=True)
        ]
        looks = [np.rint(127 * features.descriptors).astype(np.int8) for features in found]
    return Matched(given, looks, matches)


def all_models(root: Path, work: Path) -> tuple[int, list[Model]]:
    """Return how many photos a dataset has, and cam_from_world by name in each of its models."""
    scene = matched(root, work, SETTINGS)
    make = partial(_model_of, scene)
    try:
        largest = make(range(len(scene.photos)), scene.matches)
    except InvalidInput as error:
        typer.echo(f"no photo is in a model: {error.code}")
        return len(scene.photos), []
    largest = _with_late(scene, largest)
    believed = without_look_alikes(scene.photos, scene.matches)

    def make_late(rows: Sequence[int], matches: Sequence[Matches]) -> SparseModel:
        part = Matched(
            [scene.photos[row] for row in rows],
            [scene.looks[row] for row in rows],
            matches_among(rows, scene.matches),
        )
        return _with_late(part, make(rows, matches))

    models = [largest, *models_beside(largest, believed, make_late)]
    return len(scene.photos), [_poses(scene, model) for model in models]


def _model_of(scene: Matched, rows: Sequence[int], matches: Sequence[Matches]) -> SparseModel:
    """Return the largest model of some photos; raise InvalidInput without one."""
    with tempfile.TemporaryDirectory() as folder:
        return reconstruct_places(
            [scene.photos[row] for row in rows],
            lambda row: scene.looks[rows[row]],
            {},
            matches,
            CONFIG,
            (),
            Path(folder),
            lambda *_: None,
        )


def _with_late(scene: Matched, model: SparseModel) -> SparseModel:
    """Return a model with the photos that find a place in it late."""
    if model.undone or None not in model.views:
        return model
    with tempfile.TemporaryDirectory() as folder:
        return with_late_photos(
            scene.photos,
            scene.looks.__getitem__,
            scene.matches,
            model,
            CONFIG,
            Path(folder),
            lambda *_: None,
        )


def _poses(scene: Matched, model: SparseModel) -> Model:
    return {
        photo.name: view.cam_from_world
        for photo, view in zip(scene.photos, model.views, strict=True)
        if view is not None
    }


def _print(total: int, models: list[Model], place: Callable[[str], str]) -> None:
    for model in models:
        typer.echo(f"model: {dict(Counter(map(place, model)))}")
    mixed = sum(len({place(name) for name in model}) > 1 for model in models)
    typer.echo(
        f"{sum(map(len, models))} of {total} photos in models; {mixed} models hold two places"
    )


@app.command()
def hallways(
    data: Path, floor: str = "floor11", work: WorkOption = Path(".bench/joining/hallways")
) -> None:
    """Put the photos of both hallways of a floor into one folder."""
    photos, dataset = work / "photos", work / "dataset"
    for folder in (photos, dataset):
        shutil.rmtree(folder, ignore_errors=True)
    photos.mkdir(parents=True)
    for file in sorted((data / "lookalike").rglob(f"{floor}/*_hallway_*.jpg")):
        shutil.copy(file, photos)
    write_imported(read_photos(photos), dataset)
    total, models = all_models(dataset, work / "kept")
    _print(total, models, lambda name: re.sub(r"_frame.*", "", Path(name).name))


@app.command()
def walk(root: Path, work: WorkOption = Path(".bench/joining/walk")) -> None:
    """Take the photos of a walk in order, and compare with its poses, in pieces far apart."""
    dataset = read_dataset(root)
    posed, _ = collect_photos(dataset, posed=True, with_files=False, progress=lambda *_: None)
    truth = {photo.name: photo.pose for photo in posed}
    piece = {name: str(round(pose.center[0] / PIECES_APART)) for name, pose in truth.items()}
    total, models = all_models(root, work / "kept")
    _print(total, models, piece.__getitem__)
    errors = []
    for model in models:
        for which in sorted({piece[name] for name in model}):
            names = [name for name in model if piece[name] == which]
            if len(names) >= 3:
                errors += _distances({name: model[name] for name in names}, truth)
    near = np.array(errors)
    typer.echo(
        f"after alignment {(near <= 1).sum()} of {len(near)} are within 1 unit, the median "
        f"within {np.median(near):.2f}"
    )


def _distances(model: Model, truth: Mapping[str, Pose]) -> list[float]:
    """Return how far the photos of a model are from the true places, after alignment to them."""
    given = [truth[name] for name in model]
    moved = align_poses(list(model.values()), given)
    return [
        float(np.linalg.norm(moved.apply(pose.center[None])[0] - true.center))
        for pose, true in zip(model.values(), given, strict=True)
    ]


@app.command()
def small(work: WorkOption = Path(".bench/joining/small")) -> None:
    """Compare the poses of few photos of the sample with the true ones, of known cameras."""
    for images, size, seed, features, max_keypoints, top_k in SMALL:
        folder = work / f"{images} of {size[0]}x{size[1]}, seed {seed}"
        if not folder.exists():
            write_sample(folder, images=images, size=size, seed=seed)
        dataset = read_dataset(folder / "mapping")
        truth = {r.path: pose for r in dataset.images if (pose := dataset.pose(r)) is not None}
        scene = matched(
            folder / "mapping",
            work / f"kept {folder.name}",
            replace(SETTINGS, pairs=("retrieval",), pairing=PairSettings(top_k=top_k)),
            local_features=features,
            global_features=("localvlad",),
            max_keypoints=max_keypoints,
        )
        try:
            model = _poses(scene, _model_of(scene, range(len(scene.photos)), scene.matches))
        except InvalidInput:
            model = {}
        errors = 100 * np.array(_distances(model, truth) if len(model) >= 3 else [np.nan])
        typer.echo(
            f"{folder.name}, {features} {max_keypoints}, {top_k} a photo: {len(model)} placed, "
            f"rms {np.sqrt(np.mean(errors**2)):.2f} cm, largest {errors.max():.2f} cm"
        )


@app.command()
def speed(
    images: int = 500,
    code: Annotated[
        Path | None, typer.Option(help="Folder of another version's code, which builds the map.")
    ] = None,
    work: WorkOption = Path(".bench/joining/speed"),
) -> None:
    """Build a map of photos of the sample without poses; print seconds, GiB, silence."""
    work = work.resolve()
    mapping = _sample_without_poses(work / f"sample{images}", images)
    shutil.rmtree(work / "maps", ignore_errors=True)
    arguments = ["build", str(mapping), "--map", "speed", "--maps-dir", str(work / "maps")]
    started = last = time.perf_counter()
    silence, counts, before = 0.0, "", ""
    with subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments, "--method", "sfm", "--poses", "estimate"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=code,
        env=os.environ if code is None else {**os.environ, "PYTHONPATH": str(code.resolve())},
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            typer.echo(line.rstrip())
            # A line that only tells that time has passed is no sign of progress.
            told = line.split(" after ")[0]
            if told != counts:
                now = time.perf_counter()
                if now - last > silence:
                    silence, before = now - last, counts
                last, counts = now, told
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    typer.echo(
        f"{images} photos: {(time.perf_counter() - started) / 60:.1f} min, "
        f"{used.ru_maxrss / 2**20:.1f} GiB in the largest process; "
        f"longest silence {silence:.0f} s, after '{before}'"
    )


def _sample_without_poses(root: Path, images: int) -> Path:
    """The folder of the sample's mapping photos, without what tells where they were taken."""
    mapping = root / "mapping"
    if not root.exists():
        write_sample(root, images=images)
        sensors = mapping / "sensors"
        for name in ("trajectories.txt", "rigs.txt", "records_gnss.txt", "records_depth.txt"):
            (sensors / name).unlink()
        listed = (sensors / "sensors.txt").read_text().splitlines(keepends=True)
        cameras = [line for line in listed if ", depth," not in line and ", gnss," not in line]
        (sensors / "sensors.txt").write_text("".join(cameras))
    return mapping


if __name__ == "__main__":
    app()

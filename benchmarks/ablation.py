"""Measures what each repair of sparse models is worth, by leaving out one after the other.

    python -m benchmarks.ablation DATA --work FOLDER [--only castle]

A repair that had nothing to do in a set is not left out there: it would change nothing. Prints a
row for each model that is made: photos in models, of these wrong (10 % of the spread or 5 degrees
off after a robust alignment of their model, or in a model of another place), the median error of
the others, the sizes of the models, doubts, and seconds of the processor without features and
matches.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, islice
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import typer

from benchmarks.moving import write_photos
from benchmarks.trust.maps import VIDEOS
from mapping.cluster.workers import Workers
from mapping.frames.anchor import align_poses
from mapping.importers import read_model
from mapping.importers.dataset import write_imported
from mapping.methods.sfm import landmarks_from_matches
from mapping.methods.sfm_settings import SfmSettings
from mapping.methods.sparse.model import SparseModel
from mapping.sample import write_sample
from mapping.stages.context import BuildContext
from mapping.stages.global_features import describe_photos
from mapping.stages.landmarks import MadeLandmarks
from mapping.stages.local_features import local_features_source
from mapping.stages.networks import Networks
from mapping.stages.photos import collect_photos
from mapping.stages.work_folder import WorkFolder
from samples.trajectories import mapping_trajectory, stereo_rig
from visloc.errors import InvalidInput
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES
from visloc.geometry import PixelOrigin, Pose, rotation_angle
from visloc.kapture import read_dataset
from visloc.options import Inference

SETTINGS = SfmSettings(pairs=("retrieval", "sequence"), poses="estimate")
OF_PHOTOS = SfmSettings(poses="estimate", refine=("intrinsics",))
WRONG_SHARE, WRONG_DEG = 0.1, 5.0
METHODS, SPARSE = "mapping.methods", "mapping.methods.sparse"
FILTER = "without_look_alikes"


def _off(value: Any) -> Callable[..., Any]:
    return lambda *_, **__: value


def _matches(_: Any, matches: Any, *__: Any) -> Any:
    return matches


def _first(model: Any, *_: Any, **__: Any) -> Any:
    return model


# By repair: what is replaced, and by what.
REPAIRS: Mapping[str, tuple[tuple[str, ...], Callable[..., Any]]] = {
    "filter of look-alike pairs": (
        (f"{SPARSE}.triangulation.{FILTER}", f"{METHODS}.model_stage.{FILTER}"),
        _matches,
    ),
    "filter: pairs around": ((f"{SPARSE}.look_alikes._Around.share_passing",), _off(1.0)),
    "filter: third photos": ((f"{SPARSE}.look_alikes._Links.agree_with",), _off(False)),
    "pairs of many matches": ((f"{METHODS}.undoing._of_all_pairs",), _off(None)),
    "undoing": (
        (f"{METHODS}.undoing._without_two_places",),
        lambda _, __, matches, *___: matches,
    ),
    "second look": ((f"{METHODS}.sfm.with_found_cameras",), _off(None)),
    "late photos": ((f"{METHODS}.sfm.with_latecomers",), lambda _, __, model, *___: model),
    "judged cameras": ((f"{SPARSE}.triangulation._judge",), _off({})),
    "robust adjustment": ((f"{SPARSE}.triangulation.adjusted_robustly",), _first),
    "principal points": ((f"{SPARSE}.adjustment._with_principal_points",), _first),
    "thinning": ((f"{SPARSE}.triangulation.thin",), _matches),
    "fixed things": ((f"{METHODS}.sfm.find_fixed",), _off({})),
}


@dataclass(frozen=True, slots=True)
class Scene:
    """Photos without poses, and what is known of them: the place, and the pose in it."""

    root: Path
    place: Callable[[str], str]
    truth: Mapping[str, Pose] = field(default_factory=dict)
    settings: SfmSettings = SETTINGS
    local_features: str = DEFAULT_LOCAL_FEATURES
    global_features: Sequence[str] = DEFAULT_GLOBAL_FEATURES
    max_keypoints: int = 5000
    origin: PixelOrigin = PixelOrigin.CORNER


def _one_place(_: str) -> str:
    return ""


def _posed(root: Path, place: Callable[[str], str] = _one_place, **options: Any) -> Scene:
    dataset = read_dataset(root)
    truth = {r.path: pose for r in dataset.images if (pose := dataset.pose(r)) is not None}
    return Scene(root, place, truth, **options)


def _walk(root: Path) -> Scene:
    scene = _posed(root)  # in pieces 1000 units apart
    pieces = {name: str(round(pose.center[0] / 1000)) for name, pose in scene.truth.items()}
    return replace(scene, place=pieces.__getitem__)


def _folder(work: Path, name: str, files: Sequence[Path]) -> Path:
    photos, dataset = work / name / "photos", work / name / "dataset"
    if not dataset.exists():
        photos.mkdir(parents=True)
        for file in files:
            shutil.copy(file, photos)
        write_imported(read_model("images", photos), dataset)
    return dataset


def _collection(data: Path, work: Path, name: str) -> Scene:
    rows = [line.split(",") for line in (data / f"{name}_colmap.csv").read_text().splitlines()]
    truth = {
        row[0]: Pose.from_quaternion(np.array(row[4:8], float), np.array(row[8:11], float))
        for row in rows
        if len(row) == 11
    }
    root = _folder(work, name, sorted((data / name).iterdir()))
    return Scene(root, _one_place, truth, OF_PHOTOS)


def _videos(work: Path, name: str, alike: Path, pattern: str) -> Scene:
    root = _folder(work, name, sorted(alike.rglob(f"{pattern}*.jpg")))
    return Scene(root, lambda photo: re.sub(r"\d*_frame.*", "", Path(photo).name))


def _film(work: Path, what: str) -> Scene:
    folder, mounted = work / what.replace(":", ""), stereo_rig(320, 240)["left"].cam_from_rig
    poses = [mounted @ pose for pose in mapping_trajectory(24)]
    if not folder.exists():
        folder.mkdir(parents=True)
        write_photos(folder / "photos", what, poses)
    if not (folder / "dataset").exists():
        write_imported(read_model("images", folder / "photos"), folder / "dataset")
    return Scene(
        folder / "dataset",
        _one_place,
        {f"{number:02}.png": pose for number, pose in enumerate(poses)},
        replace(SETTINGS, pairs=("exhaustive",)),
        "sift",
        ("localvlad",),
        1000,
    )


def _sample(work: Path, images: int) -> Scene:
    root = work / f"sample{images}"
    if not root.exists():
        write_sample(root, images=images)
        for name in ("rigs.txt", "records_gnss.txt"):
            (root / "mapping" / "sensors" / name).unlink()
    return _posed(root / "mapping")


def scenes(data: Path, work: Path) -> dict[str, Callable[[], Scene]]:
    """Return all of them by name, each made when it is called."""
    found: dict[str, Callable[[], Scene]] = {
        "castle": lambda: _posed(data / "castle" / "mapping"),
        "redkitchen": lambda: _posed(data / "redkitchen" / "mapping"),
        "kitti_curve": lambda: _posed(data / "kitti_curve" / "mapping"),
        "virtual_gallery": lambda: _posed(
            data / "virtual_gallery" / "mapping", origin=PixelOrigin.CENTER
        ),
        "gardenspoint": lambda: _walk(data / "gardenspoint" / "mapping"),
        "drone_beach": lambda: Scene(
            _folder(work, "drone_beach", sorted((data / "drone_beach/mapping").rglob("*.*"))),
            _one_place,
            settings=OF_PHOTOS,
        ),
        "sample": lambda: _sample(work, 60),
        **{
            name: partial(_collection, data / "photo_sets", work, name)
            for name in ("et", "sacre_coeur")
        },
        **{
            what: partial(_film, work, what)
            for what in ("none", "ahead:0.4", "crossing:0.2", "crossing:0.4")
        },
    }
    alike = data / "ie_tower" / "lookalike"
    patterns = {**VIDEOS, "floor11-lobby": "f11_elevator", "floor11": "f11"}
    patterns |= {f"hallways{floor}": f"f{floor}_hallway_" for floor in ("10", "11")}
    for name, pattern in patterns.items():
        found[name] = partial(_videos, work, name, alike, pattern)
    return found


def _key(name: str, value: Any) -> Any:
    return value >= 0.5 if name == "filter: pairs around" else value


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(
            x is y or len(x.rows) == len(y.rows) for x, y in zip(a, b, strict=True)
        )
    if isinstance(a, SparseModel) and isinstance(b, SparseModel):
        return a.views == b.views
    return a is b or (isinstance(a, (bool, dict)) and a == b)


def _watched(name: str, target: str, off: Callable[..., Any], acted: set[str]) -> Any:
    """Patch that notes when a repair changes something."""
    owner, _, attribute = target.rpartition(".")
    original = getattr(resolve_name(owner), attribute)

    def watch(*given: Any, **named: Any) -> Any:
        found = original(*given, **named)
        if not _same(_key(name, found), _key(name, off(*given, **named))):
            acted.add(name)
        return found

    return patch(target, watch)


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """All but the models of a scene."""

    scene: Scene
    make: Callable[[], tuple[MadeLandmarks, ...]]


def prepared(scene: Scene, work: Path) -> Prepared:
    """Describe the photos of a scene."""
    networks = Networks(None, Inference.AUTO)
    dataset = read_dataset(scene.root).with_pixels_from(scene.origin)
    folder, workers = WorkFolder(work), Workers(1)
    source = local_features_source(
        folder,
        scene.root,
        scene.local_features,
        networks=networks,
        max_keypoints=scene.max_keypoints,
        features_dir=None,
        pixel_origin=scene.origin,
        workers=workers,
    )
    context = BuildContext(folder, source, networks, workers, lambda *_: None)
    photos, _ = collect_photos(dataset, posed=False, with_files=True, progress=lambda *_: None)
    context.run("local features", source.prepare, photos)
    described = [describe_photos(context, photos, name) for name in scene.global_features]

    def make() -> tuple[MadeLandmarks, ...]:
        made = landmarks_from_matches(
            context, dataset, photos, described, scene.settings, metric=False
        )
        return tuple(
            replace(one, notes=tuple(photos[row].name for row in one.photos)) for one in made
        )

    return Prepared(scene, make)


def _wrong(scene: Scene, made: MadeLandmarks) -> tuple[int, list[float]]:
    """Return how many photos of a model are wrong, and the errors of the others in % of spread."""
    names = made.notes
    main, _ = Counter(map(scene.place, names)).most_common(1)[0]
    elsewhere = sum(scene.place(name) != main for name in names)
    poses = {name: view.cam_from_world for name, view in zip(names, made.views, strict=True)}
    known = [n for n in names if n in scene.truth and scene.place(n) == main]
    if len(known) < 4:
        return elsewhere, []
    truth = [scene.truth[name] for name in known]
    found = [poses[name] for name in known]
    centers = np.array([pose.center for pose in truth])
    spread = np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max()
    fours = list(combinations(range(len(known)), 4))
    order = np.random.default_rng(0).permutation(len(fours)) if len(known) < 40 else None
    picks = (
        (fours[row] for row in order[:300].tolist())
        if order is not None
        else (np.random.default_rng(n).choice(len(known), 4, False) for n in range(300))
    )
    best: tuple[int, list[float]] = (0, [])
    for rows in islice(picks, 300):
        best = max(best, _agreeing(found, truth, rows, spread), key=lambda each: each[0])
    if best[0] >= 4:
        best = max(
            best, _agreeing(found, truth, np.flatnonzero(best[1]), spread), key=lambda e: e[0]
        )
    return elsewhere + len(known) - best[0], [each for each in best[1] if each]


def _agreeing(
    found: Sequence[Pose], truth: Sequence[Pose], rows: Any, spread: float
) -> tuple[int, list[float]]:
    moved = align_poses([found[row] for row in rows], [truth[row] for row in rows])
    errors = []
    for pose, true in zip(found, truth, strict=True):
        there = moved.move(pose)
        off = float(np.linalg.norm(there.center - true.center)) / spread
        turned = np.degrees(rotation_angle(there.rotation @ true.rotation.T))
        errors.append(max(off, 1e-9) if off <= WRONG_SHARE and turned <= WRONG_DEG else 0.0)
    return sum(map(bool, errors)), errors


def _row(scene: Scene, name: str, repair: str, prepared: Prepared) -> None:
    started = time.process_time()
    try:
        models = prepared.make()
    except InvalidInput as error:
        typer.echo(f"| {name} | {repair} | 0 | | {error.code} | | |")
        return
    spent = time.process_time() - started
    judged = [_wrong(scene, made) for made in models]
    errors = [each for _, right in judged for each in right]
    doubts = ", ".join(doubt.kind for made in models for doubt in made.doubts)
    sizes = " + ".join(str(len(made.views)) for made in models)
    points = sum(len(made.landmarks.points) for made in models)
    typer.echo(
        f"| {name} | {repair} | {sum(len(m.views) for m in models)} | {sum(w for w, _ in judged)} "
        f"| {100 * np.median(errors) if errors else np.nan:.2f} | {sizes} | {points} | {doubts} "
        f"| {spent:.0f} |"
    )


def main(
    data: Annotated[Path, typer.Argument(help="Folder of the datasets.")],
    work: Annotated[Path, typer.Option(help="Features and matches.")] = Path(".ablation"),
    only: Annotated[list[str] | None, typer.Option(help="Scenes.")] = None,
    without: Annotated[list[str] | None, typer.Option(help="Repairs to leave out.")] = None,
) -> None:
    """Make all models, and print the table."""
    typer.echo(
        "| photos | without | in models | wrong | median % | models | points | doubts | s |\n"
        "|---|---|---|---|---|---|---|---|---|"
    )
    for name, make in scenes(data, work).items():
        if only and name not in only:
            continue
        scene = make()
        kept = work / name.replace(":", "") / "kept"
        before = prepared(scene, kept)
        acted: set[str] = set()
        with ExitStack() as stack:
            stack.enter_context(_revision("watched"))
            for repair, (targets, off) in REPAIRS.items():
                for target in targets:
                    stack.enter_context(_watched(repair, target, off, acted))
            _row(scene, name, "nothing", before)
        for repair, (targets, off) in REPAIRS.items():
            if repair in acted and (not without or repair in without):
                with ExitStack() as stack:
                    stack.enter_context(_revision(repair))
                    for target in targets:
                        stack.enter_context(patch(target, off))
                    _row(scene, name, repair, before)


def _revision(name: str) -> Any:
    """Models of one way are not taken for those of another, nor of another run."""
    of_run = f"{name} {os.getpid()}"
    return patch.multiple(f"{METHODS}.model_stage", _REVISION=of_run, _LATE_REVISION=of_run)


if __name__ == "__main__":
    typer.run(main)

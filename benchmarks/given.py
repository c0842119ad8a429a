"""Datasets whose poses or depth maps are written wrongly: are their maps put into use?

    python -m benchmarks.given DATA --work FOLDER [--only sample]

Castle and the sample in eight wrong conventions, and with noise on their positions, are built by
each method; lund_door is built from its imported model. The depth of the sample is written in eight
wrong units. Prints a row for each map: put into use, the mistake named rightly, and the doubt.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mapping.importers import read_model
from mapping.importers.dataset import write_imported
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import MapStore
from visloc.errors import NotFound, VislocError
from visloc.geometry import Pose
from visloc.kapture import Dataset, read_dataset, write_dataset

OPENGL = np.diag([1.0, -1.0, -1.0])
# Camera axes (x right, y down, z forward) in those of a body (x forward, y left, z up).
BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
UP = np.diag([1.0, -1.0, 1.0])


def _xyzw(pose: Pose) -> Pose:
    return Pose.from_quaternion(np.roll(pose.rotation_wxyz, -1), pose.translation)


# How a cam_from_world is written, by a part of the sentence that names the mistake.
CONVENTIONS: Mapping[str, Callable[[Pose], Pose]] = {
    "camera-to-world": lambda p: p.inverse(),
    "OpenGL axes": lambda p: Pose(OPENGL @ p.rotation, OPENGL @ p.translation),
    "centre in place of": lambda p: Pose(p.rotation, p.center),
    "order x, y, z, w": _xyzw,
    "body axes": lambda p: Pose(BODY @ p.rotation, BODY @ p.translation),
    "transposed": lambda p: Pose(p.rotation.T, p.translation),
    "left-handed": lambda p: Pose(UP @ p.rotation @ UP, UP @ p.translation),
}
NOISE_CM = (5, 10, 20)
# Factors of a wrong unit: millimetres, centimetres, feet, inches, 1/5000 m read as 1/1000 m and the
# other way round, a range of 10 m in 16 bits, and a stretch.
UNITS = (1000.0, 100.0, 3.2808, 39.37, 5.0, 0.2, 6.5535, 1.2)


def main(
    data: Annotated[Path, typer.Argument(help="Folder of the datasets.")],
    work: Annotated[Path, typer.Option(help="Where datasets and maps are made.")] = Path(".given"),
    only: Annotated[str, typer.Option(help="castle, sample, lund_door or depth.")] = "",
) -> None:
    """Build all, and print the table."""
    work.mkdir(parents=True, exist_ok=True)
    sample = work / "sample"
    if not sample.is_dir():
        write_sample(sample)
    lund = work / "lund_door"
    if not lund.is_dir():
        write_imported(read_model("colmap", data / "import_samples" / "lund_door"), lund)
    sets = {
        "castle": (data / "castle" / "mapping", ("sfm", "retrieval-only")),
        "sample": (sample / "mapping", ("sfm", "rgbd", "retrieval-only")),
        "lund_door": (lund, ("model",)),
    }
    typer.echo(
        "| photos | method | written | put into use | named | doubts |\n|---|---|---|---|---|---|"
    )
    for name, (root, methods) in sets.items():
        if only in ("", name):
            for written, dataset in _written(read_dataset(root)).items():
                for method in methods:
                    _build(work, name, method, written, dataset)
    if only in ("", "depth"):
        for factor in UNITS:
            dataset = _with_depth(read_dataset(sample / "mapping"), factor, work / "depth")
            _build(work, "sample", "rgbd", f"depth {factor:g}", dataset)


def _written(dataset: Dataset) -> dict[str, Dataset]:
    poses, random = dataset.trajectories, np.random.default_rng(0)
    found = {
        name: replace(dataset, trajectories={key: write(pose) for key, pose in poses.items()})
        for name, write in CONVENTIONS.items()
    }
    keys = sorted(poses, key=lambda key: key[::-1])
    shifted = dict(zip(keys, [poses[key] for key in [*keys[1:], keys[0]]], strict=True))
    found["next photo"] = replace(dataset, trajectories=shifted)
    found["right"] = dataset
    for noise in NOISE_CM:
        moved = {
            key: Pose(p.rotation, -p.rotation @ (p.center + random.normal(0, noise / 100, 3)))
            for key, p in poses.items()
        }
        found[f"noise {noise} cm"] = replace(dataset, trajectories=moved)
    return found


def _with_depth(dataset: Dataset, factor: float, folder: Path) -> Dataset:
    """Write a dataset's raw depth maps in another unit."""
    shutil.rmtree(folder, ignore_errors=True)
    source = dataset.root / "sensors" / "records_data"
    shutil.copytree(source, folder / "sensors" / "records_data")
    for record in dataset.depth_maps:
        path = folder / "sensors" / "records_data" / record.path
        (np.fromfile(path, "<f4") * np.float32(factor)).tofile(path)
    return replace(dataset, root=folder)


def _build(work: Path, name: str, method: str, written: str, dataset: Dataset) -> None:
    place, maps, map_id = work / "dataset", work / "maps", "given"
    shutil.rmtree(place, ignore_errors=True)
    shutil.rmtree(maps, ignore_errors=True)
    place.mkdir()
    if (dataset.root / "reconstruction").is_dir():
        shutil.copytree(dataset.root / "reconstruction", place / "reconstruction")
    write_dataset(replace(dataset, root=place))
    photos = place / "sensors" / "records_data"
    if not photos.exists():
        photos.symlink_to((dataset.root / "sensors" / "records_data").resolve())
    settings = BuildSettings(place, map_id, maps_dir=maps, method=method, workers=2)
    try:
        build_map(settings, lambda *_: None)
        store = MapStore(maps)
        version = store.versions(map_id)[-1]
        doubts = store.open(f"{map_id}@{version}").manifest.parts.doubts
        told = " ".join(doubt.message for doubt in doubts)
        kinds = ", ".join(doubt.kind for doubt in doubts)
        try:
            used = "yes" if store.current_version(map_id) else "no"
        except NotFound:
            used = "no"
    except VislocError as error:
        told = " ".join(getattr(error, "__notes__", ()))
        used, kinds = "no", error.code
    named = "yes" if written in told else ""
    typer.echo(f"| {name} | {method} | {written} | {used} | {named} | {kinds} |")


if __name__ == "__main__":
    typer.run(main)

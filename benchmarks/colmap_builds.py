"""A model of one dataset by COLMAP, beside a map by ours: CPU seconds by stage.

    python -m benchmarks.colmap_builds ../shared/data/castle/mapping --way poses

COLMAP is pycolmap with SIFT on the CPU: features, matches of all pairs, then points with the
dataset's poses, or incremental mapping without poses. Its options are its own, with the dataset's
cameras. Ours is ``mapping build`` with the options of ``benchmarks.builds``, from photos to a
published map. Each runs in a process of its own, one after the other, with as many threads or
workers. Prints a table in Markdown.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated

import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
import typer

from benchmarks.builds import built, first_photos
from visloc.kapture import Dataset, read_dataset


def colmap_model(dataset: Path, way: str, threads: int, told: Connection) -> None:
    """Make a model with pycolmap; send CPU seconds by stage, and what the model holds."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    read, photos = read_dataset(dataset), dataset / "sensors" / "records_data"
    seconds, start = {}, time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        _find_features(read, photos, database, threads)
        seconds["features"], start = time.process_time() - start, time.process_time()
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads = threads
        pycolmap.match_exhaustive(database, matching, device=pycolmap.Device.cpu)
        seconds["matches, verified"], start = time.process_time() - start, time.process_time()
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = threads
        options.extract_colors = False
        if way == "poses":
            found = pycolmap.incremental_mapping(database, photos, folder, options)
            models = list(found.values())
        else:
            given = _with_poses(read, database)
            models = [pycolmap.triangulate_points(given, database, photos, folder, options=options)]
        seconds["model"] = time.process_time() - start
    best = max(models, key=lambda model: model.num_reg_images(), default=None)
    counts = (best.num_reg_images(), best.num_points3D()) if best else (0, 0)
    told.send((seconds, counts))


def _find_features(read: Dataset, photos: Path, database: Path, threads: int) -> None:
    for sensor, own in read.sensors.items():
        names = [record.path for record in read.images if record.sensor_id == sensor]
        if not names or own.camera is None:
            continue
        options = pycolmap.ImageReaderOptions()
        options.camera_model = own.camera.model
        options.camera_params = ",".join(map(str, own.camera.params))
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads = threads
        pycolmap.extract_features(
            database,
            photos,
            names,
            pycolmap.CameraMode.SINGLE,
            options,
            extraction,
            pycolmap.Device.cpu,
        )


def _with_poses(read: Dataset, path: Path) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    poses = {record.path: read.pose(record) for record in read.images}
    with pycolmap.Database.open(path) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in database.read_all_images():
            pose = poses[image.name]
            if pose is None:
                continue
            matrix = [[*row, t] for row, t in zip(pose.rotation, pose.translation, strict=True)]
            placed = pycolmap.Image(
                name=image.name, camera_id=image.camera_id, image_id=image.image_id
            )
            keypoints = database.read_keypoints(image.image_id)[:, :2]
            placed.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in keypoints])
            model.add_image_with_trivial_frame(placed, pycolmap.Rigid3d(matrix))
    return model


def main(
    dataset: Annotated[Path, typer.Argument(help="kapture folder.")],
    command: Path = Path(".venv/bin/mapping"),
    way: Annotated[
        str, typer.Option(help="sfm: with the dataset's poses; poses: without.")
    ] = "sfm",
    photos: Annotated[int | None, typer.Option(help="First so many; all.")] = None,
    workers: int = 2,
) -> None:
    """Build by both, print."""
    with tempfile.TemporaryDirectory() as folder:
        if photos is not None:
            dataset = first_photos(dataset, photos, Path(folder) / "dataset")
        _compare(dataset, command, way, Path(folder) / "maps", workers)


def _compare(dataset: Path, command: Path, way: str, maps_dir: Path, workers: int) -> None:
    own, other = multiprocessing.get_context("spawn").Pipe(duplex=False)
    start = time.perf_counter()
    process = multiprocessing.get_context("spawn").Process(
        target=colmap_model, args=(dataset, way, workers, other)
    )
    process.start()
    other.close()
    seconds, (placed, points) = own.recv()
    process.join()
    colmap_s = time.perf_counter() - start
    ours = built(command, dataset, way, maps_dir, workers)
    typer.echo("| | CPU s, COLMAP | CPU s, ours |\n|---|---|---|")
    for stage, spent in seconds.items():
        typer.echo(f"| {stage} | {spent:.1f} | |")
    for stage, cost in ours.stages.items():
        typer.echo(f"| ours: {stage} | | {cost.cpu_s:.1f} |")
    whole = sum(seconds.values())
    typer.echo(f"| **all processes** | **{whole:.1f}** | **{ours.whole.cpu_s:.1f}** |")
    typer.echo(f"| seconds of the clock | {colmap_s:.1f} | {ours.whole.wall_s:.1f} |")
    typer.echo(f"| ratio | {whole / ours.whole.cpu_s:.1f} | 1 |")
    typer.echo(f"\nCOLMAP placed {placed} photos and made {points} points.")


if __name__ == "__main__":
    typer.run(main)

"""The page with a map of a million landmarks, drawn without a graphics card (docs/performance.md).

    python -m benchmarks.page
    python -m benchmarks.page --points 3000000 --report page.json

Makes a map to look at, serves it on this machine, opens the page in Chromium (1280 x 720, software
rendering) and drags the view about. Needs ``make page``, Node.js and Chromium.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from visloc.archive import GlobalFeatures, ImageRecord, Landmarks, MapContent, pose_row, write_map
from visloc.archive.schema import FingerprintRecord
from visloc.geometry import Camera, Pose

ROOT = Path(__file__).resolve().parents[1]
MAP_ID, VERSION = "million", "v1"
READY = re.compile(r"ready: (http://[^ ]+) ")

# A storey of rooms, 6 m x 8 m x 3 m; eight in a row.
ROOM_M = np.array([6.0, 8.0, 3.0])
ROOMS, ROW = 40, 8
NOISE_M = 0.008
PHOTOS_PER_ROOM = 8
DESCRIPTOR_DIM = 8

ROWS = (
    ("first_picture_ms", "first picture, ms after the navigation"),
    ("all_drawn_ms", "all landmarks drawn, ms after the navigation"),
    ("points", "landmarks"),
    ("frames_per_second", "frames per second while dragging"),
    ("settled_frames_per_second", "... after its first second"),
    ("slowest_frame_ms", "... slowest frame, ms"),
    ("points_while_moving", "landmarks drawn while dragging, median"),
    ("rest_complete_ms", "all drawn again, ms after letting go"),
)


def main(
    points: Annotated[int, typer.Option(help="Landmarks of the map.")] = 1_000_000,
    seconds: Annotated[float, typer.Option(help="To drag the view.")] = 8,
    report: Annotated[Path | None, typer.Option(help="Write the figures here, as JSON.")] = None,
    pictures: Annotated[Path | None, typer.Option(help="Folder for what it looks like.")] = None,
) -> None:
    """Make, serve, look, print."""
    browser, node = shutil.which("chromium"), shutil.which("node")
    if browser is None or node is None:
        raise typer.BadParameter("Chromium and Node.js must be on PATH")
    with tempfile.TemporaryDirectory(prefix="visloc-page-") as folder:
        write_storey(Path(folder) / MAP_ID / VERSION, points)
        (Path(folder) / MAP_ID / "current").write_text(VERSION)
        with served(Path(folder)) as address:
            command = [node, "benchmarks/million.mjs", f"{address}/#map={MAP_ID}", browser]
            command += [str(seconds), *([] if pictures is None else [str(pictures.resolve())])]
            run = subprocess.run(
                command, cwd=ROOT / "web", check=True, stdout=subprocess.PIPE, text=True
            )
    found: dict[str, Any] = json.loads(run.stdout)
    typer.echo("| figure | value |\n|---|---|")
    for key, name in ROWS:
        value = f"{found[key]:,.0f}".replace(",", " ")
        typer.echo(f"| {name} | {value} |")
    if report is not None:
        report.write_text(json.dumps(found, indent=2) + "\n")


@contextmanager
def served(maps: Path) -> Iterator[str]:
    """The service on free ports; yields its address."""
    command = [sys.executable, "-m", "service", "--maps-dir", str(maps)]
    command += ["--http-port", "0", "--grpc-port", "0"]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            said = ""
            for line in process.stderr:
                said += line
                if ready := READY.search(line):
                    break
            else:
                raise RuntimeError(f"the service did not start:\n{said}")
            yield ready[1]
        finally:
            process.terminate()
            process.stderr.read()


def write_storey(folder: Path, num_points: int) -> None:
    """Write a map to look at: each landmark is observed once, and no photo can be localized."""
    random = np.random.default_rng(0)
    room, points = _points(random, num_points)
    by_room = np.argsort(room, kind="stable")
    points, room = points[by_room], room[by_room]
    photos = ROOMS * PHOTOS_PER_ROOM
    offsets = np.linspace(0, num_points, photos + 1).astype(np.int64)
    descriptor = np.full((1, DESCRIPTOR_DIM), DESCRIPTOR_DIM**-0.5, np.float32)
    folder.mkdir(parents=True)
    write_map(
        folder,
        MapContent(
            metric=True,
            method="generated",
            settings={"points": num_points},
            notes=("generated to be looked at: nothing can be localized in it",),
            cameras={"camera": Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))},
            rigs={},
            images=tuple(ImageRecord(f"{i:04d}.jpg", "camera", i) for i in range(photos)),
            image_poses=np.array([pose_row(_pose(i)) for i in range(photos)]),
            landmarks=Landmarks(
                origin=np.zeros(3),
                points=points.astype(np.float32),
                track_lengths=(2 + random.geometric(0.2, num_points)).astype(np.uint16),
                errors_px=np.ones(num_points, np.float32),
                angles_deg=np.full(num_points, np.nan, np.float32),
                offsets=offsets,
                observed=np.arange(num_points, dtype=np.uint32),
                keypoints=random.uniform(0, 480, (num_points, 2)).astype(np.float32),
                colors=_colors(random, room, points),
            ),
            local_fingerprint=FingerprintRecord(name="sift", revision=1, parameters={}),
            max_keypoints=int(np.diff(offsets).max()),
            descriptor_dim=DESCRIPTOR_DIM,
            descriptors=lambda: (np.repeat(descriptor, n, axis=0) for n in np.diff(offsets)),
            global_features=(
                GlobalFeatures(
                    FingerprintRecord(name="densevlad", revision=1, parameters={}),
                    np.eye(photos, DESCRIPTOR_DIM, dtype=np.float32) + np.float32(0.1),
                    {"vocabulary": np.ones((2, DESCRIPTOR_DIM), np.float32)},
                ),
            ),
            gravity=(0.0, 0.0, -1.0),
        ),
        map_id=MAP_ID,
        version=VERSION,
        created="2026-01-01T00:00:00+00:00",
    )


def _points(random: np.random.Generator, num: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The room of each landmark, and where it is: on the floor, walls, a table, a shelf, a ball."""
    room = random.integers(0, ROOMS, num)
    u, v, zero = random.random(num), random.random(num), np.zeros(num)
    direction = random.normal(size=(num, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    surfaces = (
        np.stack([6 * u, 8 * v, zero], 1),
        np.stack([6 * u, zero, 3 * v], 1),
        np.stack([zero, 8 * u, 3 * v], 1),
        np.stack([2 + 2 * u, 2 + 1.2 * v, zero + 0.8], 1),
        np.stack([0.3 + 1.2 * u, zero + 7.5, 2 * v], 1),
        0.6 * direction + [4.6, 5.0, 0.6],
    )
    points = np.choose(random.integers(0, len(surfaces), num)[:, None], surfaces)
    corner = np.stack([room % ROW * ROOM_M[0], room // ROW * ROOM_M[1], zero], 1)
    return room, points + corner + random.normal(0, NOISE_M, (num, 3))


def _colors(
    random: np.random.Generator, room: NDArray[np.int64], points: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """A colour of its own for each room, in stripes."""
    shade = random.uniform(0.3, 0.8, (ROOMS, 3))[room]
    stripes = 0.12 * (np.sin(6 * points.sum(axis=1)) > 0)[:, None]
    noise = random.normal(0, 0.03, shade.shape)
    return np.asarray(255 * np.clip(shade + stripes + noise, 0, 1), np.uint8)


def _pose(photo: int) -> Pose:
    """Of a photo from the middle of its room; they look around, level."""
    room, angle = photo // PHOTOS_PER_ROOM, 2 * np.pi * (photo % PHOTOS_PER_ROOM) / PHOTOS_PER_ROOM
    ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    rotation = np.stack([np.cross(down, ahead), down, ahead])
    place = np.array([room % ROW + 0.5, room // ROW + 0.5, 0.5]) * ROOM_M + 0.4 * ahead
    return Pose(rotation, -rotation @ place)


if __name__ == "__main__":
    typer.run(main)

"""Time and memory of pairing 10 000 posed photos, along a road and in one room.

    python benchmarks/pairing.py

Runs ``mapping pairs`` as a user would and prints a table in Markdown.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor, write_dataset

COUNT = 10_000
CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))


def centers_of(scene: str, random: np.random.Generator) -> NDArray[np.float64]:
    """Where the cameras are: a metre apart along 10 km, or anywhere in 10 x 8 m."""
    if scene == "road":
        aside = random.normal(0, 0.5, (COUNT, 2))
        return np.column_stack([np.arange(COUNT, dtype=np.float64), aside])
    return random.uniform([0, 0, 0], [10, 2.5, 8], (COUNT, 3))


def write_scene(scene: str, root: Path) -> None:
    """Write a dataset without photos, whose cameras look anywhere, nearly level."""
    random = np.random.default_rng(0)
    angles = np.column_stack([random.uniform(0, 360, COUNT), random.normal(0, 10, COUNT)])
    rotations = Rotation.from_euler("yx", angles, degrees=True).inv().as_matrix()
    centers = centers_of(scene, random)
    poses = [Pose(r, -r @ c) for r, c in zip(rotations, centers, strict=True)]
    write_dataset(
        Dataset(
            root=root,
            sensors={"cam": Sensor.with_camera("cam", CAMERA)},
            rigs={},
            trajectories={(row, "cam"): pose for row, pose in enumerate(poses)},
            images=tuple(FileRecord(row, "cam", f"{row:05d}.jpg") for row in range(COUNT)),
            depth_maps=(),
            gnss=(),
        )
    )


def main() -> None:
    """Write, pair, print."""
    command = Path(sys.executable).with_name("mapping")
    typer.echo("| scene | pairing | pairs | seconds in all | peak memory |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for scene in ("road", "room"):
            root = Path(folder) / scene
            write_scene(scene, root)
            for pairing in ("distance", "frustum"):
                started = time.perf_counter()
                arguments = [
                    "pairs",
                    str(root),
                    "--pairs",
                    pairing,
                    "--output",
                    f"{root}-{pairing}.txt",
                ]
                printed = subprocess.run(
                    [command, *arguments], check=True, capture_output=True, text=True
                ).stdout
                seconds = time.perf_counter() - started
                count, peak = re.findall(r"^(\d+) pairs|peak memory (.*)", printed, re.MULTILINE)
                typer.echo(f"| {scene} | `{pairing}` | {count[0]} | {seconds:.1f} | {peak[1]} |")


if __name__ == "__main__":
    main()

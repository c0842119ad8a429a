"""The same map from this machine and from a Ray cluster one of whose workers is killed.

    python -m benchmarks.cluster ../shared/data/redkitchen/mapping

Builds with two local workers, then on a cluster of two workers on this machine of which one is
killed (SIGKILL) in the middle of the local features; prints the content hash of both maps and what
the stages cost.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from mapping.cli.display import print_costs
from mapping.cluster.stage_timings import Costs
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.features import DEFAULT_LOCAL_FEATURES
from visloc.kapture import read_dataset, write_dataset

_out = Console()


def main(
    dataset: Annotated[Path, typer.Argument(help="kapture folder.")],
    images: Annotated[int, typer.Option(help="Photos taken of it, evenly chosen.")] = 60,
    local_features: Annotated[str, typer.Option()] = DEFAULT_LOCAL_FEATURES,
    weights_dir: Annotated[Path | None, typer.Option()] = None,
    method: Annotated[str, typer.Option()] = "sfm",
) -> None:
    """Build twice, print both."""
    # Short: the names of Ray's sockets are within it.
    folder = Path(tempfile.mkdtemp(prefix="ray", dir="/tmp"))
    os.environ["RAY_TMPDIR"] = str(folder)
    try:
        settings = BuildSettings(
            dataset=some_of(dataset, images, folder / "dataset"),
            map_id="cluster",
            maps_dir=folder / "local",
            method=method,
            local_features=local_features,
            weights_dir=weights_dir,
            workers=2,
        )
        here = build(settings, "local, two workers")
        there = build(
            replace(settings, maps_dir=folder / "ray", executor="ray", ray_address="local"),
            "ray, two workers, one killed",
            kill_in=folder,
        )
    finally:
        shutil.rmtree(folder)
    _out.print("equal" if here == there else "DIFFERENT")
    sys.exit(here != there)


def some_of(root: Path, images: int, output: Path) -> Path:
    """Write a dataset of some photos of another, whose files it links to."""
    dataset = read_dataset(root)
    count = len(dataset.images)
    rows = sorted({round(row * (count - 1) / max(images - 1, 1)) for row in range(images)})
    write_dataset(replace(dataset, root=output, images=tuple(dataset.images[r] for r in rows)))
    data = root.resolve() / "sensors" / "records_data"
    (output / "sensors" / "records_data").symlink_to(data)
    return output


def build(settings: BuildSettings, title: str, kill_in: Path | None = None) -> str:
    """Build and print; return the content hash."""
    killed: list[int] = []

    def watch(stage: str, done: int, total: int) -> None:
        if kill_in is not None and stage == "local features" and done >= total // 2 and not killed:
            for pid in busy_workers(kill_in)[:1]:  # none is, where batches are quicker than this
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    costs = Costs()
    opened = open_map(build_map(settings, watch, costs))
    content_hash = opened.manifest.content_hash
    _out.print(f"\n{title}: {content_hash}", highlight=False)
    if kill_in is not None:
        _out.print(f"killed: {killed or 'NONE, no worker was met at work'}", highlight=False)
    print_costs(_out, costs.table())
    return content_hash


def busy_workers(ray_folder: Path) -> list[int]:
    """Ids of the processes that do batches, of the cluster with this temporary folder."""
    commands = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            commands[int(folder.name)] = parent, (folder / "cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile
            continue
    option = f"--temp-dir={ray_folder}".encode()
    raylets = {pid for pid, (_, command) in commands.items() if option in command}
    return [
        pid
        for pid, (parent, command) in commands.items()
        if parent in raylets and command.startswith(b"ray::_do_batch")
    ]


if __name__ == "__main__":
    typer.run(main)

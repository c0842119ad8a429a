"""Latency and memory of maps from 100 to 100 000 photos (docs/performance.md).

    python -m benchmarks.scale
    python -m benchmarks.scale --source maps/kitchen/20261121T145500.687Z-28202d50

Makes each map (``benchmarks.large_map``), opens it in a process of its own, asks it
(``benchmarks.large_map_queries``), and removes it. The largest takes 8 GB on disk for a while.
Prints tables in Markdown.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.large_map import write_large_map
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import open_map, verify_map

COLUMNS = (
    "photos",
    "observations",
    "landmarks",
    "GB on disk",
    "bytes per observation",
    "opens in s",
    "anonymous MB: map, open",
    "process after all queries",
    "retrieval ms p50 / p95",
    "exact ms p50",
    "recall of the exact top 20",
    "whole query ms p50",
    "right answers",
    "written in s",
    "verified in s",
)


def main(
    source: Annotated[
        Path | None, typer.Option(help="A map to make them from; without it, of the sample.")
    ] = None,
    sizes: Annotated[str, typer.Option(help="Photos of each map.")] = "100,1000,10000,100000",
    per_photo: Annotated[int, typer.Option(help="Observations of a photo.")] = 500,
    queries: Annotated[int, typer.Option(help="Of each map.")] = 100,
    work: Annotated[Path | None, typer.Option(help="Where to make them.")] = None,
) -> None:
    """Make, ask, print, remove."""
    with tempfile.TemporaryDirectory(prefix="visloc-scale-", dir=work) as folder:
        real = source or sample_map(Path(folder))
        opened = open_map(real)
        local = opened.manifest.local_features
        typer.echo(
            f"From {opened.ref}: {local.fingerprint.name}, {local.descriptor_dim} dimensions.\n"
        )
        typer.echo(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
        for size in map(int, sizes.split(",")):
            with tempfile.TemporaryDirectory(dir=folder) as place:
                arrays, made = Path(place) / "arrays", Path(place) / "map"
                arrays.mkdir()
                started = time.perf_counter()
                write_large_map(opened, made, arrays, size, per_photo)
                written = time.perf_counter()
                found = asked(made, queries)
                before = time.perf_counter()
                verify_map(made)
                found |= {
                    "written_s": written - started,
                    "verified_s": time.perf_counter() - before,
                }
            typer.echo(row_of(found))


def sample_map(work: Path) -> Path:
    """Build a map of the sample's room by matching; takes a minute."""
    write_sample(work / "sample", images=24)
    settings = BuildSettings(
        work / "sample" / "mapping", "sample", work / "maps", method="sfm", local_features="sift"
    )
    return build_map(settings, lambda *_: None)


def asked(folder: Path, queries: int) -> dict[str, Any]:
    """What a process of its own found of a map."""
    command = [sys.executable, "-m", "benchmarks.large_map_queries", str(folder)]
    command += ["--queries", str(queries)]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    found: dict[str, Any] = json.loads(printed)
    return found


def row_of(found: dict[str, Any]) -> str:
    """One line of the table."""
    cells = (
        f"{found['photos']:,}",
        f"{found['observations']:,}",
        f"{found['landmarks']:,}",
        f"{found['bytes'] / 1e9:.3f}",
        f"{found['bytes'] / found['observations']:.1f}",
        f"{found['open_s']:.3f}",
        f"{found['open_mb']:.0f}",
        f"{found['process_mb']:.0f}",
        f"{found['retrieval_ms'][0]:.1f} / {found['retrieval_ms'][1]:.1f}",
        f"{found['exact_ms'][0]:.1f}",
        f"{100 * found['recall']:.1f} %",
        f"{found['query_ms'][0]:.0f}",
        f"{100 * found['right']:.0f} %",
        f"{found['written_s']:.0f}",
        f"{found['verified_s']:.1f}",
    )
    return f"| {' | '.join(cells)} |".replace(",", " ")


if __name__ == "__main__":
    typer.run(main)

"""Coarse index over thousands of generated tiles: memory, time, recall (docs/scale.md).

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.tiles --work DIR [--tiles 10000] [--photos 1000]
        [--queries 200] [--out tiles.json]

Makes the index of a set of tiles 25 m wide (``benchmarks.generated_tiles``) by the functions that
make that of real ones, writes the set into DIR, opens it in a process of its own
(``benchmarks.tiles_queries``), and asks it for the tile of generated queries: without a prior, and
knowing the position to 30 m. A run that was stopped goes on where it was. 10 000 tiles of 1000
photos take 0.8 GB in DIR, half of which is left there.

Prints tables in Markdown: what was measured, and how alike the generated photos are beside real
ones.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.generated_tiles import (
    LEVELS,
    SIMILARITIES,
    City,
    generated_model,
    similarities,
)
from visloc.archive import FingerprintRecord, SetWorld, SimilarityRecord, TileRecord
from visloc.archive.schema import Extent
from visloc.retrieval.inverted import MadeLists
from visloc_extensions.sets.coarse import TILE_LISTS, CoarseModel, coarse_index, described
from visloc_extensions.sets.files import SetContent, joined_extent, write_set

TILE_M = 25.0
# How far its photos see: a street, or a large room.
REACH_M = 10.0
BLOCK_TILES = 50
# Tiles that the similarities are measured of, as many for each query.
COMPARED_TILES, QUERIES_OF_TILE = 150, 4
PARTS = [field.name for field in fields(MadeLists)]


def main(
    work: Annotated[Path, typer.Option(help="Where to make the set; kept.")],
    tiles: int = 10_000,
    photos: int = 1000,
    queries: int = 200,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="Where to write the figures, as JSON.")] = None,
) -> None:
    """Make, ask, print."""
    city = City(tiles, photos, seed)
    model = generated_model(len(city.stds["within"]))
    folder = work / name_of(city)
    started = time.perf_counter()
    made = make_set(folder, city, model)
    typer.echo(f"made or found in {time.perf_counter() - started:.0f} s", err=True)
    asked = write_queries(folder / "queries.npz", city, queries)
    found = answers(made, asked)
    if out is not None:
        out.write_text(json.dumps(found, indent=1) + "\n")
    typer.echo(f"{tiles} tiles of {photos} photos, {queries} queries\n")
    typer.echo("| measure | value |\n|---|---|")
    for name, value in rows_of(found):
        typer.echo(f"| {name} | {value} |")
    typer.echo("\n" + compared(city, model))


def name_of(city: City) -> str:
    """Name the set after all that it is made of."""
    content = [asdict(city), TILE_LISTS, hashlib.sha256(SIMILARITIES.read_bytes()).hexdigest()]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]


def make_set(folder: Path, city: City, model: CoarseModel) -> Path:
    """Write the set into a folder, unless it is there, and return where."""
    made, unfinished = folder / "set", folder / "unfinished"
    if made.exists():
        return made
    blocks = folder / "blocks"
    blocks.mkdir(parents=True, exist_ok=True)
    lists = folder / "lists"
    lists.unlink(missing_ok=True)
    coarse = coarse_index(described_tiles(blocks, city, model), model, lists)
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    records = tuple(record_of(city, tile) for tile in range(city.num_tiles))
    extent = joined_extent([record.extent for record in records])
    content = SetContent(
        SetWorld(metric=True, extent=extent, gravity=(0.0, 0.0, -1.0)),
        FingerprintRecord(name="generated", revision=1, parameters={}, weights_sha256=None),
        records,
        coarse,
    )
    write_set(unfinished, content, set_id="city", version="1", created="2026-01-01T00:00:00+00:00")
    unfinished.rename(made)
    shutil.rmtree(blocks)
    lists.unlink()
    return made


def described_tiles(blocks: Path, city: City, model: CoarseModel) -> Iterator[MadeLists]:
    """Describe the tiles, block by block; those in the folder are read."""
    for first in range(0, city.num_tiles, BLOCK_TILES):
        path = blocks / f"{first:06}.npz"
        tiles = range(first, min(first + BLOCK_TILES, city.num_tiles))
        if not path.exists():
            made = [described(city.tile(tile).rows, model) for tile in tiles]
            unfinished = path.with_suffix(".unfinished.npz")
            parts = {name: np.array([getattr(tile, name) for tile in made]) for name in PARTS}
            np.savez(unfinished, allow_pickle=False, **parts)
            unfinished.rename(path)
        with np.load(path) as arrays:
            yield from map(MadeLists, *(arrays[name] for name in PARTS))
        typer.echo(f"\r{tiles.stop} of {city.num_tiles} tiles", err=True, nl=False)
    typer.echo(err=True)


def record_of(city: City, tile: int) -> TileRecord:
    """Say where a tile lies; photos are 1.5 m high."""
    line, column = divmod(tile, city.side)
    name = f"tile-{line:03}-{column:03}"
    west, south = column * TILE_M, line * TILE_M
    return TileRecord(
        map=name,
        version="1",
        content_hash=hashlib.sha256(name.encode()).hexdigest(),
        set_from_tile=SimilarityRecord(translation=(west, south, 0.0)),
        extent=Extent(
            min=(west - REACH_M, south - REACH_M, 0.0),
            max=(west + TILE_M + REACH_M, south + TILE_M + REACH_M, REACH_M),
        ),
        photo_extent=Extent(min=(west, south, 1.5), max=(west + TILE_M, south + TILE_M, 1.5)),
        reach=REACH_M,
        images=city.num_photos,
        landmarks=city.num_photos,
        size_bytes=0,
    )


def write_queries(path: Path, city: City, queries: int) -> Path:
    """Write descriptors (q, D), tiles (q,) and positions (q, 3) of queries."""
    random = np.random.default_rng((city.seed, 4))
    tiles = random.integers(city.num_tiles, size=queries)
    beside = random.uniform(0, TILE_M, (2, queries))
    east, north = TILE_M * (tiles % city.side), TILE_M * (tiles // city.side)
    positions = np.stack([east + beside[0], north + beside[1], np.full(queries, 1.5)], axis=1)
    rows = np.concatenate([city.tile(tile, 1).queries for tile in tiles.tolist()])
    np.savez(path, rows=rows, tiles=tiles, positions=positions)
    return path


def answers(made: Path, asked: Path) -> dict[str, Any]:
    """What a process of its own found of a set."""
    command = [sys.executable, "-m", "benchmarks.tiles_queries", str(made), str(asked)]
    # One thread, as a worker of the service has.
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    printed = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, env={**os.environ, **threads}
    ).stdout
    found: dict[str, Any] = json.loads(printed)
    return found


def rows_of(found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Name and value of what was measured."""
    yield "photos", f"{found['photos']:,}".replace(",", " ")
    yield "MB on disk: lists, centres, manifest, all", megabytes(found["disk_bytes"])
    yield "opens in s", f"{found['open_s']:.2f}"
    yield "anonymous MB: the set, the process", megabytes(found["anonymous_bytes"])
    yield "resident MB with the pages of files", megabytes(found["resident_bytes"])
    for name in ("without a prior", "position to 30 m"):
        one = found[name]
        yield f"{name}: tiles allowed, ranked", f"{one['allowed']:.0f}, {one['ranked']:.0f}"
        yield f"{name}: ranking, ms p50 / p90", " / ".join(f"{x:.1f}" for x in one["ranking_ms"])
        yield f"{name}: with the query's descriptor", " / ".join(f"{x:.1f}" for x in one["all_ms"])
        yield f"{name}: tiles searched at once, mean", f"{one['searched']:.2f}"
        shares = [f"{100 * one[key]:.1f} %" for key in ("first", "first_5", "anywhere")]
        yield f"{name}: right tile first, among 5, ranked at all", ", ".join(shares)


def megabytes(sizes: list[int]) -> str:
    """Write sizes in 10^6 bytes."""
    return ", ".join(f"{size / 1e6:.0f}" for size in sizes)


def compared(city: City, model: CoarseModel) -> str:
    """Return the table of similarities, generated photos beside real ones."""
    real = json.loads(SIMILARITIES.read_text())["quantiles"]
    tiles = np.unique(np.linspace(0, city.num_tiles - 1, COMPARED_TILES).astype(int)).tolist()
    made = similarities(city, tiles, model, QUERIES_OF_TILE)
    head = " | ".join(f"{100 * level:g} %" for level in LEVELS)
    lines = [f"| cosines | {head} |", "|---" * (1 + len(LEVELS)) + "|"]
    for name in real:
        for kind, values in (("real", real), ("generated", made)):
            cells = " | ".join(f"{value:.2f}" for value in values[name])
            lines.append(f"| {name}, {kind} | {cells} |")
    return "\n".join(lines)


if __name__ == "__main__":
    typer.run(main)

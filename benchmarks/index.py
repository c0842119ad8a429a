"""The index of one map, from generated rows: time, memory and recall, with and without priors.

    OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 python -m benchmarks.index --work DIR
        [--photos 100000] [--dim 1024] [--descriptors 2] [--queries 60] [--city] [--no-priors]

Rows are of one of two kinds. With ``--city`` they are those of ``benchmarks.generated_tiles``: as
alike as the descriptors of real photos (docs/scale.md). Queries are photos taken beside them. Else
they are isotropic, which is harder: nothing but its own list tells where a place is.
Places have 40 photos each. A photo's descriptor is the unit vector along a sum of what its place
has in common (35 % of the squared length), what one of the three directions shows that photos of
the place look in (40 %), and noise (25 %). A query is as far from a photo (cosine 0.735) as another
photo of its place and direction. So the best 20 of a query are photos of its place.

Milliseconds are those of a core, since other programs may run; one thread computes. Rows and index
are kept in DIR and found there again: a run that was stopped goes on with what is missing. Prints a
table in Markdown; the truth is the comparison of all allowed photos. "near" allows a stretch of the
map that holds the query's place, "random" any photos, "elsewhere" a stretch without the query's
place.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.generated_tiles import City
from benchmarks.large_map_queries import anonymous_mb, percentiles_ms
from visloc.retrieval.index import GlobalRows, in_8_bits, retrieve
from visloc.retrieval.inverted import InvertedFile, bytes_of, make_centers, make_lists, num_lists

Query = Mapping[str, NDArray[np.float32]]
Index = Mapping[str, GlobalRows]

PLACE, DIRECTIONS = 40, 3
TILE = 1000
SHARES = {"place": 0.35, "direction": 0.4, "noise": 0.25}
COSINE = 0.735
TOP_K = 20
# Passes over all queries: other programs may take the caches away in some of them.
PASSES = 5
PRIORS = [("none", 1.0)] + [
    (kind, share) for share in (0.5, 0.1, 0.01) for kind in ("near", "random", "elsewhere")
]
_BLOCK = 100 * PLACE


def main(
    work: Annotated[Path, typer.Option(help="Where to make rows and index; kept.")],
    photos: Annotated[int, typer.Option(help="A multiple of 4000.")] = 100_000,
    dim: int = 1024,
    descriptors: int = 2,
    queries: int = 60,
    city: Annotated[bool, typer.Option("--city", help="As alike as real ones, 242 wide.")] = False,
    priors: Annotated[bool, typer.Option(help="Ask with priors too.")] = True,
) -> None:
    """Make, ask, print."""
    work.mkdir(parents=True, exist_ok=True)
    directions = np.random.default_rng(0).integers(DIRECTIONS, size=photos)
    cities = [City(photos // TILE, TILE, seed) for seed in range(descriptors)] if city else []
    dim = len(cities[0].stds["within"]) if city else dim
    names = [f"{'city-' * city}{photos}-{dim}-{number}" for number in range(descriptors)]
    for number, name in enumerate(names):
        if not (work / f"{name}.scales.npy").exists():
            made = (
                (cities[number].tile(tile).rows for tile in range(photos // TILE))
                if city
                else rows_of_places(directions, dim, number + 1)
            )
            write_rows(work, name, made, (photos, dim))
        if not (work / f"{name}.lists").exists():
            write_lists(work, name)
    # Loads faiss, which a process does once, whatever it opens.
    InvertedFile(np.eye(1, 64, dtype=np.float32), np.zeros(1, np.int64), work)
    before, started = anonymous_mb(), time.process_time()
    index = {name: opened(work, name) for name in names}
    typer.echo(
        f"{photos} photos, {descriptors} descriptors of {dim} dimensions; opened in "
        f"{time.process_time() - started:.3f} s with {anonymous_mb() - before:.1f} MB\n"
    )
    named = dict(zip(names, cities, strict=False))
    asked = queries_in(named, queries) if city else queries_of(index, queries)
    typer.echo("| allowed | ms p50 / p95 | all compared, ms p50 | recall |\n|---|---|---|---|")
    for kind, share in PRIORS if priors else PRIORS[:1]:
        typer.echo(row_of(kind, share, index, asked))
    typer.echo(f"\n{anonymous_mb() - before:.1f} MB after all queries")


def rows_of_places(
    directions: NDArray[np.int64], dim: int, seed: int
) -> Iterator[NDArray[np.float32]]:
    """Make the rows of places, block by block."""
    random = np.random.default_rng(seed)
    for start in range(0, len(directions), _BLOCK):
        block = directions[start : start + _BLOCK]
        place = np.arange(len(block)) // PLACE
        count = -(-len(block) // PLACE)
        parts = {
            "place": _units(random, count, dim)[place],
            "direction": _units(random, DIRECTIONS * count, dim)[DIRECTIONS * place + block],
            "noise": _units(random, len(block), dim),
        }
        yield _unit(np.asarray(sum(np.float32(np.sqrt(SHARES[p])) * parts[p] for p in parts)))


def write_rows(
    work: Path, name: str, blocks: Iterable[NDArray[np.float32]], shape: tuple[int, int]
) -> None:
    """Write the rows of one descriptor as a map stores them."""
    path = work / f"{name}.npy"
    values = np.lib.format.open_memmap(path, "w+", np.dtype(np.int8), shape)
    scales, start = np.empty(len(values), np.float32), 0
    for rows in blocks:
        block = slice(start, start + len(rows))
        values[block], scales[block] = in_8_bits(rows)
        start = block.stop
    np.save(work / f"{name}.scales.npy", scales)


def write_lists(work: Path, name: str) -> None:
    """Make the inverted file of one descriptor, and say what it took."""
    rows, started = stored(work, name), time.process_time()
    centers = make_centers(rows, num_lists(len(rows)))
    clustered = time.process_time()
    lists = make_lists(rows, centers)
    typer.echo(
        f"{name}: {len(centers)} lists, k-means {clustered - started:.0f} s, assigned and coded in "
        f"{time.process_time() - clustered:.0f} s of one core\n"
    )
    np.save(work / f"{name}.centers.npy", centers)
    np.save(work / f"{name}.sizes.npy", lists.sizes)
    with (work / f"{name}.lists").open("wb") as file:
        file.writelines(bytes_of([lists]))


def stored(work: Path, name: str) -> GlobalRows:
    """Return the rows of one descriptor, mapped from their files."""
    return GlobalRows(
        np.load(work / f"{name}.npy", mmap_mode="r"),
        np.load(work / f"{name}.scales.npy", mmap_mode="r"),
    )


def opened(work: Path, name: str) -> GlobalRows:
    """Open the rows of one descriptor with their inverted file."""
    rows = stored(work, name)
    centers = np.load(work / f"{name}.centers.npy", mmap_mode="r")
    sizes = np.load(work / f"{name}.sizes.npy")
    inverted = InvertedFile(centers, sizes, work / f"{name}.lists")
    return GlobalRows(rows.values, rows.scales, inverted)


def queries_of(index: Index, count: int) -> list[tuple[int, Query]]:
    """Return photos of the map, and queries that see what they see."""
    random = np.random.default_rng(7)
    num = len(next(iter(index.values())))
    made: list[tuple[int, Query]] = []
    for photo in random.integers(num, size=count).tolist():
        query = {}
        for name, rows in index.items():
            noise = _units(random, 1, rows.values.shape[1])[0]
            other = COSINE * rows[photo] + np.sqrt(1 - COSINE**2) * noise
            query[name] = _unit(other[None])[0]
        made.append((photo, query))
    return made


def queries_in(cities: Mapping[str, City], count: int) -> list[tuple[int, Query]]:
    """Return photos of a city, and queries taken beside others of their tiles."""
    num = next(iter(cities.values())).num_tiles
    tiles = np.random.default_rng(7).choice(num, count, replace=count > num).tolist()
    return [
        (TILE * tile, {name: city.tile(tile, 1).queries[0] for name, city in cities.items()})
        for tile in tiles
    ]


def row_of(kind: str, share: float, index: Index, asked: list[tuple[int, Query]]) -> str:
    """Ask with the index and without it; one line of the table."""
    num = len(next(iter(index.values())))
    every = {name: GlobalRows(rows.values, rows.scales) for name, rows in index.items()}
    weights = [
        None if kind == "none" else prior(kind, share, photo, num, seed)
        for seed, (photo, _) in enumerate(asked)
    ]

    def answers(rows: Index, passes: int) -> tuple[list[NDArray[np.int64]], NDArray[np.float64]]:
        def ask(number: int) -> NDArray[np.int64]:
            return retrieve(asked[number][1], rows, TOP_K, weights[number]).images

        return _timed(ask, len(asked), passes)

    found, seconds = answers(index, PASSES)
    truth, exact = answers(every, 1)
    same = [len(np.intersect1d(a, b)) / TOP_K for a, b in zip(found, truth, strict=True)]
    p50, p95 = percentiles_ms(seconds.tolist())
    allowed = "all" if kind == "none" else f"{100 * share:g} %, {kind}"
    return (
        f"| {allowed} | {p50:.2f} / {p95:.2f} | {percentiles_ms(exact.tolist())[0]:.1f} "
        f"| {np.mean(same):.4f} |"
    )


def prior(kind: str, share: float, photo: int, num: int, seed: int) -> NDArray[np.float64]:
    """Return weights (num,) that allow a share of the photos."""
    random = np.random.default_rng(seed)
    count, weights = int(share * num), np.zeros(num)
    if kind == "random":
        weights[random.choice(num, count, replace=False)] = 1
        return weights
    if kind == "near":
        start = photo - int(random.integers(count))
    else:
        start = photo + PLACE + int(random.integers(num - count - 2 * PLACE))
    weights[np.arange(start, start + count) % num] = 1
    return weights


def _timed(
    ask: Callable[[int], NDArray[np.int64]], count: int, passes: int
) -> tuple[list[NDArray[np.int64]], NDArray[np.float64]]:
    """The photos found for each query, and the seconds that it took in its fastest pass."""
    seconds = np.empty((passes, count))
    for one in seconds:
        found = []
        for number in range(count):
            started = time.process_time()
            found.append(ask(number))
            one[number] = time.process_time() - started
    return found, seconds.min(axis=0)


def _units(random: np.random.Generator, count: int, dim: int) -> NDArray[np.float32]:
    return _unit(random.standard_normal((count, dim), dtype=np.float32))


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


if __name__ == "__main__":
    typer.run(main)

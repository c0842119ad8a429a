"""What a city takes, worked out from what other commands measured (docs/scale.md).

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.capacity MAP QUERY_DATASET --build build.txt
        --tiles tiles.json [--performance docs/performance.md] [--features faster2d2]

MAP is the folder of a map, such as maps/ID, build.txt what ``mapping build`` printed when it made
it, and QUERY_DATASET a kapture dataset with photos as users send them. tiles.json is what
``benchmarks.tiles --out`` wrote. docs/performance.md holds the tables that
``make bench`` printed. Measures itself only what a photo costs the coarse index.

Prints tables in Markdown: what was measured, and what follows for the city and the machines that
the options describe.
"""

from __future__ import annotations

import json
import math
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.generated_tiles import generated_model
from visloc.archive import Map, MapStore
from visloc.features.descriptors.whitening import WHITENING_MAX_DIMS
from visloc.kapture import read_dataset
from visloc.sets.coarse import described, descriptors_of

_STAGE = re.compile(r"^\s*(\S.*?)\s+(\d+)?\s+([\d.]+)\s+([\d.]+)\s+([\d.]+)\s*$")


@dataclass(frozen=True, slots=True)
class Costs:
    """What was measured.

    Attributes:
        build_core_s: seconds of one core that a photo of a map takes to build, by stage.
        index_core_s: ... and to be described for the coarse index.
        photo_bytes: of a map, per photo.
        model_bytes: of a map, per dimension of its global descriptors; they have as many as it has
            photos, or ``WHITENING_MAX_DIMS``.
        coarse_bytes: of the coarse index on disk, per photo.
        coarse_process_bytes: anonymous memory that the set takes in each process.
        coarse_file_bytes: pages of its files that ranking all tiles reads; processes share them.
        process_bytes: anonymous memory of a process after queries of a large map.
        query_core_s: seconds of one core that a query in one map takes, in a busy service.
        tile_core_s: ... that matching and solving in one more tile takes.
        coarse_core_s: ... that ranking all tiles takes.
        open_core_s: ... that opening a tile takes.
        open_bytes: anonymous memory of an open tile.
        tiles_searched: by a query without a prior, on average.
        query_bytes: of a photo that is sent.
    """

    build_core_s: dict[str, float]
    index_core_s: float
    photo_bytes: float
    model_bytes: float
    coarse_bytes: float
    coarse_process_bytes: float
    coarse_file_bytes: float
    process_bytes: float
    query_core_s: float
    tile_core_s: float
    coarse_core_s: float
    open_core_s: float
    open_bytes: float
    tiles_searched: float
    query_bytes: float


@dataclass(frozen=True, slots=True)
class City:
    """What is to be served.

    Attributes:
        photos: of mapping.
        tiles: of the same size.
        night_h: hours that a build may take.
        queries_per_s: at the busiest time.
    """

    photos: int
    tiles: int
    night_h: float
    queries_per_s: float


@dataclass(frozen=True, slots=True)
class Machine:
    """What there is to build and to serve on."""

    cores: int
    memory_bytes: float
    disk_bytes: float
    network_bytes_per_s: float


@dataclass(frozen=True, slots=True)
class Capacity:
    """What follows.

    Attributes:
        tile_bytes: of one tile.
        coarse_bytes: of the coarse index.
        build_core_s: seconds of one core that all photos take.
        build_machines: to do that in a night.
        index_core_s: seconds of one core to describe all photos for the coarse index.
        query_core_s: seconds of one core that a query without a prior takes, its tiles open.
        opening_core_s: what opening its tiles adds when queries are spread evenly over the city, so
            that each worker process has few of them open.
        replicas: machines whose cores answer the queries, tiles open.
        replicas_opening: ... when queries are spread evenly.
        replica_bytes: memory of a replica without any tile.
        open_share: of all tiles that one worker process has open when memory is full; pages of
            their files are not counted, and come from the disk again where there is no room.
        open_file_bytes: of the files of these tiles, of all worker processes.
        disk_share: of all tiles that a replica's disk holds.
        fill_s: to copy these from object storage.
        received_share: of a replica's network, for the photos of queries.
    """

    tile_bytes: float
    coarse_bytes: float
    build_core_s: float
    build_machines: int
    index_core_s: float
    query_core_s: float
    opening_core_s: float
    replicas: int
    replicas_opening: int
    replica_bytes: float
    open_share: float
    open_file_bytes: float
    disk_share: float
    fill_s: float
    received_share: float


def capacity(costs: Costs, city: City, machine: Machine) -> Capacity:
    """Work it out."""
    photos_of_tile = city.photos / city.tiles
    dims = min(photos_of_tile - 1, WHITENING_MAX_DIMS)
    tile_bytes = photos_of_tile * costs.photo_bytes + dims * costs.model_bytes
    tiles_bytes = city.tiles * tile_bytes
    build_core_s = city.photos * sum(costs.build_core_s.values())
    more_tiles = costs.tiles_searched - 1
    query_core_s = costs.query_core_s + costs.coarse_core_s + more_tiles * costs.tile_core_s
    process_bytes = costs.process_bytes + costs.coarse_process_bytes
    replica_bytes = machine.cores * process_bytes + costs.coarse_file_bytes
    room = max(machine.memory_bytes - replica_bytes, 0) / machine.cores
    open_share = min(room / costs.open_bytes / city.tiles, 1.0)
    opening_core_s = costs.tiles_searched * (1 - open_share) * costs.open_core_s
    replicas = math.ceil(city.queries_per_s * query_core_s / machine.cores)
    every = query_core_s + opening_core_s
    disk_share = min(machine.disk_bytes / tiles_bytes, 1.0)
    received = city.queries_per_s / replicas * costs.query_bytes
    return Capacity(
        tile_bytes=tile_bytes,
        coarse_bytes=city.photos * costs.coarse_bytes,
        build_core_s=build_core_s,
        build_machines=math.ceil(build_core_s / (machine.cores * city.night_h * 3600)),
        index_core_s=city.photos * costs.index_core_s,
        query_core_s=query_core_s,
        opening_core_s=opening_core_s,
        replicas=replicas,
        replicas_opening=math.ceil(city.queries_per_s * every / machine.cores),
        replica_bytes=replica_bytes,
        open_share=open_share,
        open_file_bytes=min(machine.cores * open_share, 1.0) * tiles_bytes,
        disk_share=disk_share,
        fill_s=disk_share * tiles_bytes / machine.network_bytes_per_s,
        received_share=received / machine.network_bytes_per_s,
    )


def stage_costs(printed: str) -> tuple[int, dict[str, float]]:
    """Read photos, and seconds of a core per photo by stage, from what ``mapping build`` printed.

    Raises:
        ValueError: when there is no table in it.
    """
    _, found, table = printed.partition("CPU seconds")
    photos = re.search(r"^\s*photos\s+(\d+)", printed, re.MULTILINE)
    if not found or photos is None:
        raise ValueError("no table of costs; give what mapping build printed, from begin to end")
    count = int(photos[1])
    stages = {}
    for line in table.splitlines():
        match = _STAGE.match(line)
        if match is not None and match[1] != "in all":
            stages[match[1]] = float(match[4]) / count
    return count, stages


def cell(document: str, heading: str, row: str, column: str) -> float:
    """Read a number from a table in Markdown.

    Args:
        document: the text.
        heading: of the chapter that the table is in.
        row: what its first cell holds.
        column: the head of the column.

    Raises:
        ValueError: when it is not there.
    """
    chapter = document.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    head: list[str] = []
    for line in chapter.splitlines():
        cells = [text.strip() for text in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            head = []
        elif not head:
            head = cells
        elif cells[0] == row and column in head:
            number = re.match(r"[\d ]*\d(\.\d+)?", cells[head.index(column)])
            if number is not None:
                return float(number[0].replace(" ", ""))
    raise ValueError(f"no cell {column!r} of {row!r} in the chapter {heading!r}")


def measured(
    opened: Map,
    queries: Path,
    built: str,
    tiles: dict[str, Any],
    performance: str,
    features: str,
) -> Costs:
    """Put together what was measured; arguments as of the command."""
    chapter = f"redkitchen, `{features}`"
    threads = re.search(r", (\d+) threads", performance.partition(f"## {chapter}")[2])
    if threads is None:
        raise ValueError(f"the chapter {chapter!r} does not say how many threads it had")
    cores = int(threads[1])
    sizes = {name: entry.size for name, entry in opened.manifest.files.items()}
    models = {name: size for name, size in sizes.items() if name.endswith(".model.npz")}
    dims = max(record.dim for record in opened.manifest.global_features)
    steps = ("matching", "pose")
    word_dim = opened.manifest.local_features.descriptor_dim
    model = generated_model(dims, word_dim=word_dim)
    started = time.process_time()
    described(descriptors_of(opened, model), model)
    described_s = time.process_time() - started
    searched = tiles["without a prior"]
    large = "Maps at scale"
    return Costs(
        build_core_s=stage_costs(built)[1],
        index_core_s=described_s / len(opened.images),
        photo_bytes=(sum(sizes.values()) - sum(models.values())) / len(opened.images),
        model_bytes=sum(models.values()) / dims,
        coarse_bytes=tiles["disk_bytes"][-1] / tiles["photos"],
        coarse_process_bytes=tiles["anonymous_bytes"][0],
        coarse_file_bytes=tiles["resident_bytes"][0] - tiles["anonymous_bytes"][1],
        process_bytes=1e6 * cell(performance, large, "100 000", "process after all queries"),
        query_core_s=cores / cell(performance, chapter, "concurrency 8", "queries per second"),
        tile_core_s=cores * sum(cell(performance, chapter, step, "`default`") for step in steps),
        coarse_core_s=searched["all_ms"][0] / 1e3,
        open_core_s=cell(performance, large, "1 000", "opens in s"),
        open_bytes=1e6 * cell(performance, large, "1 000", "anonymous MB: map, open"),
        tiles_searched=searched["searched"],
        query_bytes=mean_size(queries),
    )


def mean_size(queries: Path) -> float:
    """Return the mean size of the photos of a dataset, in bytes."""
    dataset = read_dataset(queries)
    sizes = [dataset.path_of(record).stat().st_size for record in dataset.images]
    return sum(sizes) / len(sizes)


def table_of_costs(costs: Costs) -> str:
    """Return what was measured as a table in Markdown."""
    stages = {f"build, {stage}": f"{1e3 * s:.0f} ms" for stage, s in costs.build_core_s.items()}
    return table(
        "measured, seconds of one core",
        {
            **{f"{name}, per photo": value for name, value in stages.items() if value != "0 ms"},
            "build in all, per photo": f"{sum(costs.build_core_s.values()):.2f} s",
            "coarse index, per photo": f"{1e3 * costs.index_core_s:.1f} ms",
            "map, per photo": f"{costs.photo_bytes / 1e3:.0f} kB",
            "models of a map, per photo, to 1024 photos": f"{costs.model_bytes / 1e3:.0f} kB",
            "coarse index on disk, per photo": f"{costs.coarse_bytes:.0f} bytes",
            "a worker process, without pages of files": f"{costs.process_bytes / 1e9:.2f} GB",
            "the coarse index, in each process": f"{costs.coarse_process_bytes / 1e9:.2f} GB",
            "the coarse index, pages of files": f"{costs.coarse_file_bytes / 1e9:.2f} GB",
            "a query in one map": f"{costs.query_core_s:.2f} s",
            "ranking all tiles": f"{costs.coarse_core_s:.3f} s",
            "matching and pose in one more tile": f"{costs.tile_core_s:.2f} s",
            "opening a tile of 1000 photos": f"{costs.open_core_s:.2f} s",
            "an open tile of 1000 photos, in memory": f"{costs.open_bytes / 1e6:.0f} MB",
            "tiles searched at once, mean": f"{costs.tiles_searched:.1f}",
            "a photo that is sent": f"{costs.query_bytes / 1e3:.0f} kB",
        },
    )


def table_of_capacity(found: Capacity, city: City) -> str:
    """Return what follows as a table in Markdown."""
    all_core_s = found.query_core_s + found.opening_core_s
    return table(
        "a city",
        {
            "one tile": f"{found.tile_bytes / 1e6:.0f} MB",
            "storage: all tiles": f"{city.tiles * found.tile_bytes / 1e12:.2f} TB",
            "storage: coarse index": f"{found.coarse_bytes / 1e9:.2f} GB",
            "build": f"{found.build_core_s / 3600:.0f} core hours",
            f"machines to build it in {city.night_h:g} h": f"{found.build_machines}",
            "coarse index, described by one process": f"{found.index_core_s / 3600:.1f} h",
            "a query without a prior, its tiles open": f"{found.query_core_s:.2f} core seconds",
            f"replicas for {city.queries_per_s:g} queries per second": f"{found.replicas}",
            "the same with its tiles to open": f"{all_core_s:.2f} core seconds",
            f"replicas for that, {city.queries_per_s:g} per second": f"{found.replicas_opening}",
            "memory of a replica, no tile open": f"{found.replica_bytes / 1e9:.1f} GB",
            "tiles that a worker has open in the rest": f"{found.open_share * city.tiles:.0f}",
            "files of these tiles, of all workers": f"{found.open_file_bytes / 1e9:.0f} GB",
            "share of the tiles on the disk of a replica": f"{100 * found.disk_share:.0f} %",
            "to copy them there": f"{found.fill_s / 60:.0f} min",
            "network of a replica, photos that come in": f"{100 * found.received_share:.1f} %",
        },
    )


def table(title: str, rows: dict[str, str]) -> str:
    """Return a table in Markdown of two columns."""
    return "\n".join([f"| {title} | |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())])


def main(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="Such as maps/ID.")],
    query_dataset: Annotated[Path, typer.Argument(help="kapture folder.")],
    build: Annotated[Path, typer.Option(help="What mapping build printed.")],
    tiles: Annotated[Path, typer.Option(help="What benchmarks.tiles --out wrote.")],
    performance: Path = Path("docs/performance.md"),
    features: str = "faster2d2",
    photos: Annotated[int, typer.Option(help="Of the city.")] = 10_000_000,
    num_tiles: Annotated[int, typer.Option(help="Of the city.")] = 10_000,
    night_h: float = 10.0,
    queries_per_s: float = 1000.0,
    cores: Annotated[int, typer.Option(help="Of a machine.")] = 32,
    memory_gb: float = 128.0,
    disk_tb: float = 4.0,
    network_gbit_per_s: float = 10.0,
) -> None:
    """Read, work it out, print."""
    costs = measured(
        MapStore(map_folder.parent).open(map_folder.name),
        query_dataset,
        build.read_text(),
        json.loads(tiles.read_text()),
        performance.read_text(),
        features,
    )
    city = City(photos, num_tiles, night_h, queries_per_s)
    machine = Machine(cores, memory_gb * 1e9, disk_tb * 1e12, network_gbit_per_s * 1e9 / 8)
    typer.echo(table_of_costs(costs) + "\n")
    typer.echo(
        f"{machine.cores} cores, {memory_gb:g} GB, {disk_tb:g} TB, {network_gbit_per_s:g} Gbit/s:\n"
    )
    typer.echo(table_of_capacity(capacity(costs, city, machine), city))


if __name__ == "__main__":
    typer.run(main)

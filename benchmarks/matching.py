"""Measure what matching a photo costs, in blocks of 256 rows and in blocks that fit a cache.

    python -m benchmarks.matching MAP QUERY [--weights-dir DIR] [--photos 6] [--repeats 9]

MAP is a folder of a map's versions, QUERY a kapture dataset. The descriptors of some of its photos
are matched with those of the photos that the map retrieves: plainly, in blocks of 256 rows with
NumPy's maxima as it was once done, and as the product does it. Both are asked in turn, and must
find the same pairs. Prints a table in Markdown, in milliseconds of one thread's processor time per
query: of each photo the least of its repeats, of the photos the median.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from visloc.archive import MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.images import read_photo_file
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.matching.correspondences import Pairs, mutual_nearest_neighbours
from visloc.matching.products import EightBitRows, block_rows, row_products
from visloc.options import LocalizeOptions

ROWS_BEFORE = 256
PARTS = ("products", "largest of each row", "largest of each column", "in all")

# The descriptors of a query and those of each photo that it is matched with.
Matched = tuple[EightBitRows, Sequence[EightBitRows]]


def matched_plainly(a: EightBitRows, b: EightBitRows) -> Pairs:
    """Do what ``mutual_nearest_neighbours`` does, in large blocks."""
    products = row_products(a.rows, b.rows, ROWS_BEFORE)
    best_b, best = np.empty(len(a), dtype=np.int64), np.empty(len(a), dtype=np.float64)
    column_best = np.full(len(b), -np.inf)
    for start in range(0, len(a), ROWS_BEFORE):
        rows = slice(start, min(start + ROWS_BEFORE, len(a)))
        similarity = products(rows).numpy()
        np.argmax(similarity, axis=1, out=best_b[rows])
        best[rows] = similarity[np.arange(len(similarity)), best_b[rows]]
        np.maximum(column_best, similarity.max(axis=0), out=column_best)
    mutual = np.flatnonzero(best == column_best[best_b])
    _, first = np.unique(best_b[mutual], return_index=True)
    mutual = mutual[np.sort(first)]
    return mutual, best_b[mutual], (best[mutual] * (a.scale * b.scale)).astype(np.float32)


def parts(a: EightBitRows, b: EightBitRows, most_rows: int) -> list[float]:
    """Return the seconds of each part but the last, in blocks of so many rows."""
    products = row_products(a.rows, b.rows, most_rows)
    seconds = np.zeros(3)
    for start in range(0, len(a), most_rows):
        times = [time.thread_time()]
        block = products(slice(start, min(start + most_rows, len(a))))
        times.append(time.thread_time())
        block.numpy().argmax(axis=1)
        times.append(time.thread_time())
        block.amax(dim=0)
        times.append(time.thread_time())
        seconds += np.diff(times)
    return [float(each) for each in seconds]


def measure(matched: Matched, repeats: int) -> list[list[float]]:
    """Return the least seconds of each of ``PARTS``, before and now, in turn.

    Raises:
        AssertionError: both find different pairs.
    """
    query, photos = matched
    for b in photos:
        before, now = matched_plainly(query, b), mutual_nearest_neighbours(query, b)
        for part in range(3):
            assert np.array_equal(before[part], now[part])
    ways: list[tuple[Callable[[EightBitRows, EightBitRows], Pairs], Callable[[int], int]]] = [
        (matched_plainly, lambda _: ROWS_BEFORE),
        (mutual_nearest_neighbours, block_rows),
    ]
    least = [[np.inf] * len(PARTS) for _ in ways]
    for _ in range(repeats):
        for way, (match, rows) in enumerate(ways):
            start = time.thread_time()
            for b in photos:
                match(query, b)
            whole = time.thread_time() - start
            each = np.sum([parts(query, b, rows(len(b))) for b in photos], axis=0)
            least[way] = [min(*pair) for pair in zip(least[way], [*each, whole], strict=True)]
    return least


def looked_at(localizer: Localizer, query: Path, num_photos: int) -> Iterator[Matched]:
    """Yield what some photos of a dataset, evenly spaced, are matched with."""
    dataset = read_dataset(query)
    for record in dataset.images[:: max(1, len(dataset.images) // num_photos)][:num_photos]:
        photo = read_photo_file(dataset.path_of(record))
        look = localizer.look(photo, dataset.sensors[record.sensor_id].camera, LocalizeOptions())
        if look.shown is not None and look.proposed is not None:
            seen = [localizer.geometry.observed(image)[1] for image in look.proposed.photos]
            yield look.shown.descriptors, [each for each in seen if len(each)]


def main(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="A folder of map versions.")],
    query: Annotated[Path, typer.Argument(help="A kapture dataset.")],
    weights_dir: Path | None = None,
    photos: int = 6,
    repeats: int = 9,
) -> None:
    """Match in both ways, print."""
    opened = MapStore(map_folder.parent).open(map_folder.name)
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(
        opened,
        make_local_features(name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    matched = list(looked_at(localizer, query, photos))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    least = np.median([measure(each, repeats) for each in matched], axis=0) * 1e3
    torch.set_num_threads(threads)
    keypoints = np.median([len(own) for own, _ in matched])
    landmarks = np.median([sum(map(len, seen)) for _, seen in matched])
    typer.echo(f"{name}: {keypoints:.0f} keypoints, {landmarks:.0f} landmarks of mapping photos")
    typer.echo("| ms per query | blocks of 256 rows | blocks that fit the cache | ratio |")
    typer.echo("|---|---|---|---|")
    for part, (before, now) in zip(PARTS, least.T, strict=True):
        typer.echo(f"| {part} | {before:.1f} | {now:.1f} | {before / now:.2f} |")


if __name__ == "__main__":
    typer.run(main)

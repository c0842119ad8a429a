"""Measure what matching a photo costs: by torch in blocks, and by compiled code.

    python -m benchmarks.matching MAP QUERY [--weights-dir DIR] [--photos 6] [--repeats 9]

MAP is a folder of a map's versions, QUERY a kapture dataset. The descriptors of some of its photos
are matched with those of the photos that the map retrieves: in torch, as on machines without
compiled code, and compiled for each kind of processor that this one is. All are asked in turn, and
must find the same nearest rows. Prints a table in Markdown, in milliseconds of one thread's
processor time per query: of each photo the least of its repeats, of the photos the median.
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
from numpy.typing import NDArray

from visloc.archive import MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.matching import compiled
from visloc.matching.compiled import NearestColumns
from visloc.matching.products import EightBitRows, nearest_by_torch
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file

# The descriptors of a query and those of each photo that it is matched with.
Matched = tuple[EightBitRows, Sequence[EightBitRows]]
Way = Callable[[NDArray[np.int8], NDArray[np.int8], bool], NearestColumns]


def ways() -> dict[str, Way]:
    """Return all ways of this machine by name."""
    found: dict[str, Way] = {"torch": nearest_by_torch}
    for level in range(1, compiled.level() + 1):
        name = f"compiled, {compiled.PROCESSORS[level]}"
        found[name] = partial(compiled.nearest_columns, at_level=level)
    return found


def measure(matched: Matched, repeats: int) -> list[float]:
    """Return the least seconds of each way, asked in turn.

    Raises:
        AssertionError: they find different rows.
    """
    query, photos = matched
    for photo in photos:
        found = [way(query.rows, photo.rows, False) for way in ways().values()]
        for other in found[1:]:
            assert np.array_equal(found[0].best, other.best)
            assert np.array_equal(found[0].columns, other.columns)
            assert np.array_equal(found[0].column_best, other.column_best)
    least = [np.inf] * len(ways())
    for _ in range(repeats):
        for number, way in enumerate(ways().values()):
            start = time.thread_time()
            for photo in photos:
                way(query.rows, photo.rows, False)
            least[number] = min(least[number], time.thread_time() - start)
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
    """Match in all ways, print."""
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
    typer.echo("| by | ms per query | torch's time / its own | GOP/s |")
    typer.echo("|---|---|---|---|")
    dim = opened.manifest.local_features.descriptor_dim
    for name, each in zip(ways(), least, strict=True):
        rate = 2 * keypoints * landmarks * dim / each / 1e6
        typer.echo(f"| {name} | {each:.1f} | {least[0] / each:.2f} | {rate:.0f} |")


if __name__ == "__main__":
    typer.run(main)

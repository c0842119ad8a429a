"""The command ``mapping prune``."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from mapping.cli.acceptance import require_acceptance
from mapping.cli.display import ERR, OUT, say
from mapping.cli.progress import StageProgress
from mapping.options import AcceptOption, MapsDirOption, WeightsDirOption
from visloc.archive import Map, MapStore
from visloc.errors import refuse
from visloc.features import make_global_descriptor, make_local_features
from visloc_extensions.living_maps.pruning.accuracy import BINS, Accuracy, lost, of_queries
from visloc_extensions.living_maps.pruning.job import Pruned, prune_map

# More lost queries than this share of all, and than this number, are more than noise.
_NOISE_SHARE, _NOISE_QUERIES = 0.05, 2
_UNITS = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
_SIZE = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?(%|[KMG]i?B|)", re.IGNORECASE)


def prune(
    map_id: Annotated[str, typer.Argument(metavar="MAP", help="Id of the map, or id@version.")],
    max_bytes: Annotated[
        str | None,
        typer.Option(help="Largest size of the map, such as 200MB, or 50% of its size now."),
    ] = None,
    max_landmarks: Annotated[
        int | None, typer.Option(min=1, help="Or the largest number of landmarks.")
    ] = None,
    queries: Annotated[
        Path | None,
        typer.Option(
            help="kapture folder of photos with poses in the map's frame, to measure accuracy. "
            "Default: photos of the map, each localized in the rest of it."
        ),
    ] = None,
    accept: AcceptOption = False,
    maps_dir: MapsDirOption = Path("maps"),
    weights_dir: WeightsDirOption = None,
) -> None:
    """Make a map smaller: keep what localization needs most of each photo.

    A new version is published; the old one stays. The accuracy before and after is printed.
    """
    if (max_bytes is None) == (max_landmarks is None):
        raise refuse("prune.goal", field="--max-bytes")
    store = MapStore(maps_dir)
    opened = store.open(map_id)
    with StageProgress(ERR, if_stopped="nothing was published") as progress:
        measure = None
        if queries is not None:
            local = opened.manifest.local_features.fingerprint.name
            extractor = make_local_features(local, weights_dir)
            make_descriptor = partial(make_global_descriptor, weights_dir=weights_dir)

            def measure(before: Map, after: Map) -> tuple[Accuracy, Accuracy]:
                told = partial(progress, "before and after")
                assert queries is not None
                first, second = of_queries(
                    (before, after), queries, extractor, make_descriptor, told
                )
                return first, second

        pruned = prune_map(
            store,
            opened.ref,  # a percentage refers to the size of this version
            max_bytes=None if max_bytes is None else parse_size(max_bytes, opened.size_bytes),
            max_landmarks=max_landmarks,
            measure=measure,
            accept=accept,
            progress=progress,
        )
    print_pruned(pruned, "queries" if queries is not None else "photos of the map")
    require_acceptance(pruned.after, accept=accept, pictures=maps_dir / ".work" / ".doubts")


def parse_size(text: str, whole: int) -> int:
    """Return the bytes meant by ``200MB``, ``1.5 GiB``, ``50%`` or a number."""
    found = _SIZE.fullmatch(text.strip())
    size = 0.0
    if found is not None:
        number, unit = float(found[1]), found[2].upper()
        size = number / 100 * whole if unit == "%" else number * _UNITS[unit]
    if size < 1:
        raise refuse("prune.max_bytes", field="--max-bytes", got=text)
    return int(size)


def print_pruned(pruned: Pruned, asked: str) -> None:
    """Print sizes and accuracy before and after."""
    before, after = pruned.before, pruned.after
    metric = after.manifest.world.metric
    say(f"map {after.ref}")
    table = Table(box=None)
    for name in ("", "before", "after"):
        table.add_column(name, justify="right" if name else "left")
    rows = [
        ("MB", *(f"{opened.size_bytes / 1e6:.1f}" for opened in (before, after))),
        *(
            (name, *(str(getattr(opened.manifest.counts, field)) for opened in (before, after)))
            for name, field in (
                ("photos", "images"),
                ("landmarks", "landmarks"),
                ("observations", "observations"),
            )
        ),
        *accuracy_rows(pruned.accuracy, metric=metric),
    ]
    for row in rows:
        table.add_row(*row)
    OUT.print(table, highlight=False)
    first, second = pruned.accuracy
    say(f"accuracy is that of {first.queries} {asked}")
    worst = lost(first, second, metric=metric)
    if worst > max(_NOISE_QUERIES, _NOISE_SHARE * first.queries):
        say(
            f"note: {worst} queries of {first.queries} were lost, which is more than chance; "
            f"{before.ref} is kept"
        )


def accuracy_rows(accuracies: tuple[Accuracy, ...], *, metric: bool) -> list[tuple[str, ...]]:
    """Return rows of a table of accuracies: queries within each bin, and medians."""
    rows = [("localized", *(f"{len(one.errors)} of {one.queries}" for one in accuracies))]
    if metric:
        for bin_ in BINS:
            name = f"{bin_.max_position_error_m * 100:g} cm, {bin_.max_orientation_error_deg:g} deg"
            rows.append((name, *(str(one.within(bin_)) for one in accuracies)))
    medians = [one.medians for one in accuracies]
    unit, factor = ("cm", 100.0) if metric else ("units", 1.0)
    rows.append((f"median, {unit}", *(f"{factor * median[0]:.3g}" for median in medians)))
    rows.append(("median, deg", *(f"{median[1]:.3g}" for median in medians)))
    return rows

"""``localize compare``."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from clients.cli.display import print_failed
from clients.cli.options import (
    Connection,
    Photos,
    QueryOptions,
    Thresholds,
    spread,
    thresholds_of,
)
from clients.cli.progress import run_with_progress
from clients.evaluation.readers import Reader, takes_features
from clients.evaluation.results import check_can_be_written, write_whole
from visloc.errors import refuse
from visloc_api.words.maps import MapInfo
from visloc_extensions.research.cli.compare_display import (
    command_text,
    markdown_of,
    print_comparison,
)
from visloc_extensions.research.evaluation.compare import (
    DEFAULT_VALUES,
    Asked,
    Axis,
    ask_each,
    make_comparison,
    make_variants,
    parse_values,
)

_out = Console()
_err = Console(stderr=True)

_DEFAULTS = "; ".join(f"{axis}: {','.join(words)}" for axis, words in DEFAULT_VALUES.items())


@dataclass(frozen=True, kw_only=True)
class Comparison(Photos, QueryOptions):
    """The options that say what is compared."""

    map_refs: Annotated[
        list[str],
        typer.Option(
            "--map",
            metavar="ID",
            help="id, or id@version; several for --axis local-features, one for each.",
        ),
    ]
    axis: Annotated[
        Axis,
        typer.Option(
            help="What varies. local-features: the maps. global-features: each of the map's alone, "
            "then all together. Others: the option of this name."
        ),
    ]
    values: Annotated[
        str | None,
        typer.Option(
            metavar="VALUE,VALUE...",
            help="The rows of the table; for global-features also sums such as "
            f"densevlad+localvlad, and all. Default: {_DEFAULTS}.",
        ),
    ] = None
    threshold: Thresholds = None
    repeat: Annotated[
        int,
        typer.Option(min=1, max=100, help="How often each photo is sent with each value."),
    ] = 1

    def readers(self, maps: Sequence[MapInfo]) -> dict[str, Reader]:
        """Choose what is sent to each map, by ``MapInfo.ref``; raises as ``choose_reader``."""
        # Of several maps, those that take photos have no use for a folder of features.
        return {
            info.ref: self.reader(info, with_features_dir=len(maps) == 1 or takes_features(info))
            for info in maps
        }


@spread
def compare(
    *,
    context: typer.Context,
    comparison: Comparison,
    output: Annotated[
        Path, typer.Option(help="Folder for compare.md, compare.png and compare.json.")
    ],
    connection: Connection,
) -> None:
    """Compare features, fusions, matchers or solvers: one axis varies, all else stays fixed.

    Writes a table with recall, errors, times and the size of the map for each value (compare.md,
    below the command that made it), a picture of it (compare.png) and all figures (compare.json).

    Each photo is sent with every value in turn, one request at a time. The first request of each
    value is a warm-up. A value that the server refuses, such as a matcher that does not know the
    map's features, gets a row that says so. Needs matplotlib: the extra compare of visloc.

    Exits with 0 when done, 1 on an error, 130 when stopped; then nothing was written.
    """
    draw = _drawing()
    options, thresholds = comparison.options, thresholds_of(comparison.threshold)
    values, queries = parse_values(comparison.values), comparison.read().photos
    with connection.client() as client:
        maps, about = [client.map(ref) for ref in comparison.map_refs], client.server_info()
    variants = make_variants(comparison.axis, values, maps, options)
    readers = comparison.readers(maps)
    _make_folder(output)
    table, picture, figures = (output / f"compare.{kind}" for kind in ("md", "png", "json"))
    check_can_be_written([table, picture, figures])
    repeats, seed = comparison.repeat, options.seed or 0
    asked: list[Asked] = []

    async def work(advance: Callable[[], None]) -> None:
        async with connection.async_client() as client:
            asked[:] = await ask_each(
                *(client, variants, queries, readers), repeats=repeats, seed=seed, advance=advance
            )

    total = len(variants) * len(queries) * repeats
    run_with_progress(_err, work, "requests", total, "nothing was written")
    made = make_comparison(
        *(comparison.axis, asked, thresholds, queries, about),
        command=command_text(context.obj or ()),
        options=options.given(),
        repeats=repeats,
        seed=seed,
    )
    image = draw(made)
    write_whole(figures, [json.dumps(made, indent=2, allow_nan=False).encode() + b"\n"])
    write_whole(picture, [image])
    write_whole(table, [markdown_of(made, picture.name).encode()])
    print_comparison(_out, made)
    outcomes = (outcome for each in asked for outcome in each.run.outcomes)
    failed = {outcome.query.name: outcome for outcome in outcomes if outcome.error is not None}
    print_failed(_err, list(failed.values()))


def _make_folder(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refuse("output.folder", field="output", got=f"{output}: {error.strerror}") from error


def _drawing() -> Callable[[Mapping[str, Any]], bytes]:
    """Find out before a long run whether there is something to draw with."""
    if importlib.util.find_spec("matplotlib") is None:
        raise refuse("compare.matplotlib")
    from visloc_extensions.research.cli.compare_plot import draw_comparison

    return draw_comparison

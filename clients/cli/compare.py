"""``localize compare``."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from clients.cli.compare_display import command_text, markdown_of, print_comparison
from clients.cli.connection_options import (
    DEFAULT_SERVER,
    ApiKeyFile,
    Ca,
    Server,
    TimeoutS,
    api_key_of,
)
from clients.cli.display import print_failed
from clients.cli.progress import run_with_progress
from clients.cli.query_options import (
    FeaturesDir,
    Options,
    Origin,
    Seed,
    Source,
    Thresholds,
    options_of,
    thresholds_of,
)
from clients.client import DEFAULT_TIMEOUT_S, AsyncClient, Client
from clients.evaluation.compare import (
    DEFAULT_VALUES,
    Asked,
    Axis,
    ask_each,
    make_comparison,
    make_variants,
    parse_values,
)
from clients.evaluation.queries import read_queries
from clients.evaluation.results import check_can_be_written, write_whole
from clients.evaluation.sending import choose_reader, takes_features
from visloc.errors import refuse
from visloc.geometry import PixelOrigin

_out = Console()
_err = Console(stderr=True)

_DEFAULTS = "; ".join(f"{axis}: {','.join(words)}" for axis, words in DEFAULT_VALUES.items())


def compare(
    context: typer.Context,
    source: Source,
    map_refs: Annotated[
        list[str],
        typer.Option(
            "--map",
            metavar="ID",
            help="id, or id@version; several for --axis local-features, one for each.",
        ),
    ],
    axis: Annotated[
        Axis,
        typer.Option(
            help="What varies. local-features: the maps. global-features: each of the map's alone, "
            "then all together. Others: the option of this name."
        ),
    ],
    output: Annotated[
        Path, typer.Option(help="Folder for compare.md, compare.png and compare.json.")
    ],
    values: Annotated[
        str | None,
        typer.Option(
            metavar="VALUE,VALUE...",
            help="The rows of the table; of global-features also sums such as densevlad+localvlad, "
            f"and all. Without it {_DEFAULTS}.",
        ),
    ] = None,
    server: Server = DEFAULT_SERVER,
    option: Options = None,
    seed: Seed = None,
    threshold: Thresholds = None,
    repeat: Annotated[
        int,
        typer.Option(min=1, max=100, help="Times that each photo is asked about with each value."),
    ] = 1,
    features_dir: FeaturesDir = None,
    pixel_origin: Origin = PixelOrigin.CORNER,
    api_key_file: ApiKeyFile = None,
    ca: Ca = None,
    timeout_s: TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Compare features, fusions, matchers or solvers: one axis varies, all else stays fixed.

    Writes a table with recall, errors, times and the size of the map for each value (compare.md,
    below the command that made it), a picture of it (compare.png) and all figures (compare.json).

    The values take turns photo by photo, one request at a time, after one request of each that is
    not counted. A value that the server refuses, such as a matcher that the map's features have
    none of, is a row that says so. Needs matplotlib: the extra compare of visloc.

    Exits with 0 when done, 1 on an error, 130 when stopped; then nothing was written.
    """
    draw = _drawing()
    options, thresholds = options_of(option, seed), thresholds_of(threshold)
    words = parse_values(values)
    queries = read_queries(source, pixel_origin).photos
    key = api_key_of(api_key_file)
    with Client(server, api_key=key, ca=ca, timeout_s=timeout_s) as client:
        maps, about = [client.map(ref) for ref in map_refs], client.server_info()
    variants = make_variants(axis, words, maps, options)
    readers = {
        info.ref: choose_reader(
            *(source, info),
            # Of several maps those that take photos have no use for it.
            features_dir if len(maps) == 1 or takes_features(info) else None,
            pixel_origin,
        )
        for info in maps
    }
    _make_folder(output)
    table, picture, figures = (output / f"compare.{kind}" for kind in ("md", "png", "json"))
    check_can_be_written([table, picture, figures])
    order = options.seed or 0
    asked: list[Asked] = []

    async def run(advance: Callable[[], None]) -> None:
        async with AsyncClient(server, api_key=key, ca=ca, timeout_s=timeout_s) as client:
            asked[:] = await ask_each(
                *(client, variants, queries, readers), repeats=repeat, seed=order, advance=advance
            )

    total = len(variants) * len(queries) * repeat
    run_with_progress(_err, run, "requests", total, "nothing was written")
    comparison = make_comparison(
        *(axis, asked, thresholds, queries, about),
        command=command_text(context.obj or ()),
        options=options.given(),
        repeats=repeat,
        seed=order,
    )
    image = draw(comparison)
    write_whole(figures, [json.dumps(comparison, indent=2, allow_nan=False).encode() + b"\n"])
    write_whole(picture, [image])
    write_whole(table, [markdown_of(comparison, picture.name).encode()])
    print_comparison(_out, comparison)
    outcomes = (outcome for each in asked for outcome in each.outcomes.values())
    failed = {outcome.query.name: outcome for outcome in outcomes if outcome.error is not None}
    print_failed(_err, list(failed.values()))


def _make_folder(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refuse("output.folder", field="output", got=f"{output}: {error.strerror}") from error


def _drawing() -> Callable[[Mapping[str, Any]], bytes]:
    """Find out before a long run whether there is something to draw with.

    Raises:
        InvalidInput: ``compare.matplotlib``.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise refuse("compare.matplotlib")
    from clients.cli.compare_plot import draw_comparison

    return draw_comparison

"""``localize retrieve``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from clients.cli.display import print_failed
from clients.cli.options import Connection, MapRef, Photos, QueryOptions, spread
from clients.cli.progress import run_with_progress
from clients.evaluation.results import check_can_be_written
from clients.evaluation.run import Outcome, QueryClient, localize_all
from visloc.kapture.pairs import check_pair_names, write_pair_rows

_out = Console()
_err = Console(stderr=True)


@spread
def retrieve(
    *,
    photos: Photos,
    map_ref: MapRef,
    query: QueryOptions,
    output: Annotated[Path, typer.Option(metavar="FILE", help="The pairs file to write.")],
    concurrency: Annotated[int, typer.Option(min=1, max=1024, help="Photos sent at once.")] = 1,
    connection: Connection,
) -> None:
    """Write the mapping photos that a map retrieves for each photo, best first, with their scores.

    The file is one for --pairs of localize batch, and for kapture's tools. The number of mapping
    photos is --option top_k=20. The server localizes each photo, and its answer names them.

    Exits with 0 when done, 1 on an error, 130 when stopped; then nothing was written.
    """
    options, queries = query.options, photos.read().photos
    check_pair_names(output, [each.name for each in queries])
    check_can_be_written([output])
    with connection.client() as client:
        info = client.map(map_ref)
    read = photos.reader(info)
    found: dict[str, Outcome] = {}

    async def work(advance: Callable[[], None]) -> None:
        def keep(outcome: Outcome) -> None:
            found[outcome.query.name] = outcome
            advance()

        async with connection.async_client() as client:
            asked = QueryClient(client, info.ref, options, read)
            await localize_all(queries, asked.localize, concurrency, keep)

    run_with_progress(_err, work, "photos", len(queries), "nothing was written")
    outcomes = [found[each.name] for each in queries]
    num_pairs = write_query_pairs(output, outcomes)
    _out.print(f"{num_pairs} pairs of {len(queries)} photos", highlight=False)
    print_failed(_err, [outcome for outcome in outcomes if outcome.error is not None])


def write_query_pairs(path: Path, outcomes: Iterable[Outcome]) -> int:
    """Write the mapping photos that each answer was matched with, best first.

    Returns:
        How many pairs were written.
    """
    rows = [
        (outcome.query.name, image.image, image.score)
        for outcome in outcomes
        if outcome.result is not None
        for image in outcome.result.retrieved
    ]
    write_pair_rows(path, rows)
    return len(rows)

"""Which mapping photos each query is matched with: from a file, or as a map retrieves them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from clients.evaluation.pose_files import of_photos
from clients.evaluation.queries import Query
from clients.evaluation.run import Outcome
from visloc.errors import refuse
from visloc.kapture.pairs import read_pair_rows, write_pair_rows


def read_query_pairs(path: Path, queries: Sequence[Query]) -> dict[str, tuple[str, ...]]:
    """Read the mapping photos of each query, in the order of the file, each once.

    Scores are not used: like kapture and hloc, the file has the best photo first. Pairs of other
    photos are left out.

    Raises:
        DatasetError: as ``read_pair_rows``; ``pairs.no_query`` when it is about other photos only.
    """
    photos: dict[str, dict[str, None]] = {}
    for pair in read_pair_rows(path):
        photos.setdefault(pair.first, {})[pair.second] = None
    found, _ = of_photos(photos, [query.name for query in queries])
    if not found:
        raise refuse(
            "pairs.no_query",
            field=str(path),
            expected=f"pairs such as of {queries[0].name}",
            got=next(iter(photos), "no pair"),
        )
    return {name: tuple(named) for name, named in found.items()}


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

"""Which mapping photos each query is matched with, and which photos names in files stand for."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar
from urllib.parse import unquote

from clients.evaluation.queries import Query
from visloc.errors import refuse
from visloc.kapture.pairs import read_pair_rows

_T = TypeVar("_T")


def of_photos(found: Mapping[str, _T], photos: Iterable[str]) -> tuple[dict[str, _T], int]:
    """Find the photos that the names of a file stand for.

    A name stands for the photo of that name. Otherwise it stands for the photo whose path ends
    with it, as visuallocalization.net has base names for some data sets.

    Returns:
        The values by the photos' names, and the number of names that stand for no photo; those that
        begin with ``#``, as comments do, aside.
    """
    photos = list(photos)
    exact = set(photos)
    ending: dict[str, list[str]] = defaultdict(list)
    for photo in photos:
        parts = photo.split("/")
        for start in range(1, len(parts)):
            ending["/".join(parts[start:])].append(photo)
    values: dict[str, _T] = {}
    unknown = 0
    for name, value in found.items():
        # Our own files write a blank as %20; other tools' files do not decode names.
        spellings = dict.fromkeys((name, unquote(name)))
        known = [each for each in spellings if each in exact]
        fits = known or next((ending[each] for each in spellings if each in ending), [])
        if len(fits) > 1:
            raise refuse("poses.ambiguous", field=name, got=", ".join(fits[:3]))
        if not fits:
            unknown += not name.startswith("#")
        elif fits[0] in values:
            raise refuse("poses.duplicate", field=name, got=fits[0])
        else:
            values[fits[0]] = value
    return values, unknown


def read_query_pairs(path: Path, queries: Sequence[Query]) -> dict[str, tuple[str, ...]]:
    """Read the mapping photos of each query, in the order of the file, each once.

    Scores are not used: like kapture and hloc, the file has the best photo first. Pairs of other
    photos are left out.
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

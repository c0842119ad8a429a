"""Other light, weather, seasons and cameras: who is found, and where the others are lost.

    python -m benchmarks.change [--data-dir ../shared/data] [--maps-dir DIR] [--only NAME ...]

Asks gardenspoint by day and at night, and photos of redkitchen, castle, kitti_curve and
gardenspoint under nine kinds of synthetic change, and the painted room under a tenth. Each answer
becomes a line of JSON in ``--answers-dir``; a run that was interrupted goes on. Prints tables in
Markdown.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.change.kinds import KINDS, ROOM, changed, changed_room
from benchmarks.change.stages import Staged, Staging
from benchmarks.change.table import write_tables
from benchmarks.trust.asking import Maps
from benchmarks.trust.maps import SAMPLE, Places, make_missing
from benchmarks.trust.outcomes import Query
from benchmarks.trust.queries import resized_to
from benchmarks.trust.scenarios import RIGHT, RIGHT_AT_NIGHT, night, photos_of

# Every so-manieth query of each map is changed.
EVERY = {"redkitchen": 8, "castle": 3, "kitti_curve": 16, "gardenspoint": 30}
EVERY_ROOM = 2
WIDEST_PX = 1024
UNCHANGED = "unchanged"
DAY, NIGHT, BY_NUMBER = "day", "night", "night by number"
NAMES = (DAY, NIGHT, BY_NUMBER, UNCHANGED, *KINDS, ROOM)


def main(
    data_dir: Annotated[Path, typer.Option(help="The shared data sets.")] = Path("../shared/data"),
    maps_dir: Annotated[Path, typer.Option(help="A store of maps; missing ones are built.")] = Path(
        ".trust/maps"
    ),
    answers_dir: Annotated[Path, typer.Option(help="Answers are kept there.")] = Path(".change"),
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(NAMES)}.")] = None,
) -> None:
    """Ask what has not been asked yet, and print the tables."""
    chosen = only or list(NAMES)
    unknown = set(chosen) - set(NAMES)
    if unknown:
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: one of {', '.join(NAMES)}")
    places = Places(data_dir, maps_dir)
    make_missing(places, {*EVERY, SAMPLE}, lambda line: typer.echo(line, err=True))
    maps, staging = Maps(places.store, None), dict[str, Staging]()
    answers_dir.mkdir(parents=True, exist_ok=True)
    found: list[Staged] = []
    for name in chosen:
        path = answers_dir / f"{name.replace(' ', '-')}.jsonl"
        known = list(_read(path))
        asked = {(each.condition, each.map_id, each.photo) for each in known}
        with path.open("a", buffering=1, encoding="utf-8") as lines:
            for condition, query in _queries(places, name):
                if (condition, query.map_id, query.name) in asked:
                    continue
                if query.map_id not in staging:
                    staging[query.map_id] = Staging(maps.localizer(query.map_id))
                by_number = name == BY_NUMBER
                staged = staging[query.map_id].ask(query, condition, by_number=by_number)
                lines.write(json.dumps(asdict(staged)) + "\n")
                known.append(staged)
        found += known
    for line in write_tables(found):
        typer.echo(line)


def _read(path: Path) -> Iterator[Staged]:
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            yield Staged(**json.loads(line))


def _queries(places: Places, name: str) -> Iterator[tuple[str, Query]]:
    """Yield each query of a condition, and the row that it counts in."""
    if name == DAY:
        for query in photos_of(places, name, "gardenspoint", "query", RIGHT):
            yield name, query
    elif name == NIGHT:
        for query in photos_of(places, name, "gardenspoint", "query_night", RIGHT_AT_NIGHT):
            yield name, query
    elif name == BY_NUMBER:
        for query in night(places):
            yield name, query
    elif name == UNCHANGED:
        for query in _some(places):
            yield name, query
    else:
        for level in range(3):
            for query in _room(places) if name == ROOM else _some(places):
                yield f"{name} {level + 1}", _changed(name, level, query)


def _some(places: Places) -> Iterator[Query]:
    for map_id, every in EVERY.items():
        for query in list(photos_of(places, map_id, map_id, "query", RIGHT))[::every]:
            yield _at_most_as_wide(query)


def _at_most_as_wide(query: Query) -> Query:
    """Reduce a wide photo: changes take time by the pixel, and features see no more of them."""
    (only,) = query.photos
    assert only.camera is not None
    width = min(only.photo.width, WIDEST_PX)
    height = round(only.photo.height * width / only.photo.width)
    small = resized_to(only.photo.rgb, width, height)
    camera = only.camera.scaled(width, height)
    photo = replace(only.photo, rgb=small.rgb)
    return replace(query, photos=(replace(only, photo=photo, camera=camera),))


def _room(places: Places) -> Iterator[Query]:
    yield from list(photos_of(places, SAMPLE, SAMPLE, "query", RIGHT))[::EVERY_ROOM]


def _changed(name: str, level: int, query: Query) -> Query:
    (only,) = query.photos
    assert only.camera is not None
    assert query.truth is not None
    photo, camera = only.photo, only.camera
    if name == ROOM:
        photo = changed_room(level, query.name, camera, query.truth)
    else:
        photo, camera = changed(name, level, query.name, photo, camera)
    return replace(query, photos=(replace(only, photo=photo, camera=camera),))


if __name__ == "__main__":
    typer.run(main)

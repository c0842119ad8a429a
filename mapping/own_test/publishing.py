"""Publishing maps that took their own test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from mapping.cluster.executors import Executor
from mapping.cluster.stage_timings import wrote
from mapping.cluster.workers import THIS_PROCESS
from mapping.own_test.trials import run_own_test
from mapping.own_test.verdict import doubts_about
from mapping.progress import Progress, nothing_told, one_step
from mapping.stages.publishing import link_photos, new_version
from visloc.archive import Map, MapContent, MapStore, add_own_test, open_map, write_map
from visloc.archive.checks import read_manifest
from visloc.archive.schema import Doubt
from visloc.errors import NotFound, refuse

# Kinds of doubts that no test of the finished map finds again.
_OF_THE_BUILD = ("depth", "left_out", "matches", "order", "poses", "scale", "unit")
Examine = Callable[[Map], Sequence[Doubt]]
"""What else speaks against a map, beside its own test."""


def publish_edited(
    store: MapStore,
    content: MapContent,
    map_id: str,
    *,
    photos: Sequence[Path] = (),
    based_on: str | None = None,
    accept: bool = False,
    carried: Sequence[Doubt] = (),
    progress: Progress = nothing_told,
) -> Path:
    """Test content made from maps, and publish it as a version of a map.

    A version that its own test speaks against is published, but not made current.

    Args:
        photos: small copies of all photos, in their order; or none.
        based_on: the version that the content was made from, if it is one of the same map.
        accept: make it current all the same.
        carried: doubts about the map that the content was made from.

    Returns:
        The folder of the new version.
    """
    if photos and len(photos) != len(content.images):
        raise AssertionError(f"{len(photos)} pictures of {len(content.images)} photos")
    with store.incoming() as incoming:
        link_photos(incoming, photos)
        version = write_content(incoming, content, map_id, carried=carried, progress=progress)
        return publish_tested(store, incoming, map_id, version, based_on=based_on, accept=accept)


def publish_tested(
    store: MapStore,
    incoming: Path,
    map_id: str,
    version: str,
    *,
    based_on: str | None = None,
    accept: bool = False,
) -> Path:
    """Publish what ``write_content`` wrote; make it current unless there are doubts.

    Doubts that the base version had too do not count, because somebody put that version into use.
    """
    doubts, known = read_manifest(incoming).parts.doubts, tuple[Doubt, ...]()
    if based_on is not None:
        with suppress(NotFound):  # store.publish tells
            known = store.open(f"{map_id}@{based_on}").manifest.parts.doubts
    is_doubtful = any(doubt not in known for doubt in doubts)
    return store.publish(
        incoming, map_id, version, based_on=based_on, make_current=accept or not is_doubtful
    )


def refuse_not_accepted(store: MapStore, opened: Map) -> None:
    """Refuse to make something of a version in doubt that nobody put into use.

    The result could pass its own test and be put into use, because that test cannot find all
    doubts: photos that found no place, for one, are not in the version any more.
    """
    map_id, version = opened.manifest.id, opened.manifest.version
    if not opened.manifest.parts.doubts:
        return
    with suppress(NotFound):
        if store.current_version(map_id) == version:
            return
    raise refuse("map.doubtful", field="MAP", ref=opened.ref)


def write_content(
    folder: Path,
    content: MapContent,
    map_id: str,
    left_out: Sequence[str] = (),
    examine: Examine | None = None,
    carried: Sequence[Doubt] = (),
    progress: Progress = nothing_told,
    workers: Executor = THIS_PROCESS,
) -> str:
    """Write content beside the files that a folder has already, test it, and return its version.

    What the content knows of the map it was made from is learned anew.

    Args:
        carried: doubts about the map that the content was made from. Those that only its build
            could find are kept.
        progress: of the stages "archive" and "own test".
        workers: where the photos of its own test are localized.
    """
    version, created = new_version()
    with one_step(progress, "archive"):
        write_map(folder, content, map_id=map_id, version=version, created=created)
        wrote(sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()))
    opened = open_map(folder)
    run = run_own_test(opened, partial(progress, "own test"), workers)
    doubts = (
        *doubts_about(opened, run, left_out),
        *(examine(opened) if examine else ()),
        *(doubt for doubt in carried if doubt.kind in _OF_THE_BUILD),
    )
    return add_own_test(folder, run.test, version=version, doubts=doubts)

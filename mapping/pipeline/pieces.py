"""The maps of one build: photos without poses may fall apart into pieces, each a map of its own.

The largest piece has the id that was asked for, such as ``room``; the others are ``room-2``,
``room-3`` and so on, the larger ones first. A map of such an id that is no piece of ``room`` is
passed over. The pieces have no common frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path

from pydantic import JsonValue

from mapping.own_test.publishing import publish_tested
from visloc.archive import MapStore
from visloc.archive.checks import read_manifest
from visloc.archive.schema import ID_PATTERN, PIECES, Manifest
from visloc.errors import MapCorrupt, NotFound, refuse

# As many digits fit behind the id.
_LONGEST_SUFFIX = "-999"


@dataclass(frozen=True, slots=True)
class WrittenMap:
    """A complete version that is not published yet."""

    folder: Path
    map_id: str
    version: str
    photos: int

    @property
    def ref(self) -> str:
        return f"{self.map_id}@{self.version}"


def refuse_long_id(map_id: str) -> None:
    """Refuse an id that leaves no room for the ids of pieces."""
    if not ID_PATTERN.fullmatch(f"{map_id}{_LONGEST_SUFFIX}"):
        raise refuse(
            "map.id",
            "this id is not valid, or too long for the ids of pieces of the map",
            field="--map",
            expected=f"up to {64 - len(_LONGEST_SUFFIX)} letters, digits, '.', '_', '-', "
            "beginning with a letter or digit",
            got=map_id,
        )


def ids_of_pieces(store: MapStore, map_id: str, num: int) -> list[str]:
    """Return the ids of a number of pieces, the largest first."""
    return [map_id, *islice(_free_ids(store, map_id), num - 1)]


def note_of_piece(piece_id: str, map_id: str) -> str:
    """Return the note by which a later build knows a piece of a map.

    It names the piece, since maps that are merged of pieces have their notes and are none.
    """
    return (
        f"{piece_id} is a piece of {map_id}: nothing links its photos to the others of that build"
    )


def note_of_largest(pieces: Sequence[WrittenMap]) -> str:
    """Return the note that names the pieces beside the largest one."""
    others = ", ".join(f"{each.ref} of {each.photos} photos" for each in pieces)
    return (
        f"the photos fell apart into {len(pieces) + 1} pieces that nothing links for sure, and "
        f"this map is of the largest. The others are maps of their own: {others}. Photos of the "
        "way between them would link them"
    )


def without_pieces(settings: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Return the settings of a method for a map that is not, or no more, as a build made it."""
    return {name: value for name, value in settings.items() if name != PIECES}


def use_version(store: MapStore, map_id: str, version: str) -> list[str]:
    """Put a version into use; of a build that falls apart into pieces, these as well.

    As when a build is published, a piece that its own test speaks against is not put into use, and
    pieces of other builds are taken out of use.

    Returns:
        ``id@version`` of all that are in use now, the given one first.
    """
    manifest = store.outline(f"{map_id}@{version}").manifest
    used: list[str] = []
    if isinstance(manifest, Manifest) and PIECES in manifest.method.settings:
        stale = set(_known_pieces(store, map_id))
        for ref in manifest.pieces:
            piece_id, _, piece_version = ref.partition("@")
            if not _is_piece(store, piece_id, map_id):
                continue  # removed, or of another map
            with suppress(MapCorrupt, NotFound):
                piece = store.outline(ref).manifest
                if isinstance(piece, Manifest) and not piece.parts.doubts:
                    store.set_current(piece_id, piece_version)
                    stale.discard(piece_id)
                    used.append(ref)
        for piece_id in sorted(stale):
            store.withdraw(piece_id)
    store.set_current(map_id, version)
    return [f"{map_id}@{version}", *used]


def publish_pieces(store: MapStore, pieces: Sequence[WrittenMap], *, accept: bool) -> Path:
    """Publish the maps of a build, which replace those of the build before.

    If the test of the largest piece speaks against it, none is put into use, and those that were
    stay. Otherwise each is put into use unless its own test speaks against it, and pieces of
    earlier builds that none replaces are taken out of use. The largest is published last: once it
    is there, all are.

    Returns:
        The folder of the largest.
    """
    largest, *others = pieces
    for each in others:
        if store.versions(each.map_id) and not _is_piece(store, each.map_id, largest.map_id):
            raise refuse(
                "map.exists",
                f"a map {each.map_id!r} was published while this build was making a piece of that "
                "name; the same command makes the pieces again under other names",
                field="--map",
            )
    is_used = accept or not _is_doubtful(largest)
    stale = set(_known_pieces(store, largest.map_id)) if is_used else set()
    for each in others:
        is_current = is_used and (accept or not _is_doubtful(each))
        store.publish(each.folder, each.map_id, each.version, make_current=is_current)
        if is_current:
            stale.discard(each.map_id)
    for map_id in sorted(stale):
        store.withdraw(map_id)
    return publish_tested(store, largest.folder, largest.map_id, largest.version, accept=accept)


def _is_doubtful(written: WrittenMap) -> bool:
    return bool(read_manifest(written.folder).parts.doubts)


def _free_ids(store: MapStore, map_id: str) -> Iterator[str]:
    for number in count(2):
        piece_id = f"{map_id}-{number}"
        if not store.versions(piece_id) or _is_piece(store, piece_id, map_id):
            yield piece_id


def _known_pieces(store: MapStore, map_id: str) -> Iterator[str]:
    """Yield the ids of maps that earlier builds made as pieces of a map."""
    for other in store.ids():
        start, _, number = other.rpartition("-")
        if start == map_id and number.isdecimal() and _is_piece(store, other, map_id):
            yield other


def _is_piece(store: MapStore, piece_id: str, map_id: str) -> bool:
    note = note_of_piece(piece_id, map_id)
    # A file may say which version is current although there is none.
    for last in store.versions(piece_id)[-1:]:
        with suppress(MapCorrupt, NotFound):  # damaged, or removed meanwhile
            return note in store.outline(f"{piece_id}@{last}").manifest.notes
    return False

"""Rules that keep a set and its tiles consistent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from visloc.archive.schema import FingerprintRecord, Manifest
from visloc.archive.set_schema import SetManifest
from visloc.errors import MapCorrupt, NotFound, VislocError, refuse

AnyManifest = Manifest | SetManifest
# Yields the manifests of (id, version) in order; raises NotFound for a missing one.
ReadManifests = Callable[[Sequence[tuple[str, str]]], Iterator[AnyManifest]]


def refuse_other_kind(incoming: AnyManifest, published: AnyManifest | None) -> None:
    """Refuse a set under the id of a map, and a map under that of a set.

    Args:
        published: any version of the same id in the store; None if there is none.
    """
    if published is None or isinstance(published, SetManifest) == isinstance(incoming, SetManifest):
        return
    code = "set.id_is_map" if isinstance(incoming, SetManifest) else "map.id_is_set"
    raise refuse(code, field="map", got=incoming.id)


def refuse_missing_tiles(incoming: AnyManifest, read_manifests: ReadManifests) -> None:
    """Refuse a set unless the store has each of its tiles with the content that the set names."""
    if not isinstance(incoming, SetManifest):
        return
    manifests = read_manifests([(tile.map, tile.version) for tile in incoming.tiles])
    for tile in incoming.tiles:
        try:
            found = next(manifests)
        except NotFound as error:
            raise refuse(
                "set.tile", field="tiles", expected=tile.ref, got=error.message, kind=NotFound
            ) from error
        if isinstance(found, SetManifest) or found.content_hash != tile.content_hash:
            raise refuse(
                "set.tile",
                "the store has another tile under this name; build the set again",
                field="tiles",
                expected=f"{tile.ref}, a map of content hash {tile.content_hash}",
                got="a set" if isinstance(found, SetManifest) else found.content_hash,
            )
        refuse_other_features(tile.ref, found.local_features.fingerprint, incoming.local_features)


def refuse_other_features(ref: str, found: FingerprintRecord, expected: FingerprintRecord) -> None:
    """Refuse a tile whose local features differ from those of the set."""
    if found != expected:
        raise refuse("set.features", field="tiles", expected=str(expected), got=str(found), ref=ref)


def refuse_if_tile(map_id: str, version: str, current: Iterable[tuple[str, AnyManifest]]) -> None:
    """Refuse to remove a version that a current set names.

    Args:
        current: references and manifests of the current versions.
    """
    for ref, manifest in current:
        if isinstance(manifest, SetManifest) and any(
            (tile.map, tile.version) == (map_id, version) for tile in manifest.tiles
        ):
            raise refuse(
                "map.in_set",
                field="map",
                expected=f"a version that {ref} does not name",
                got=f"{map_id}@{version}",
            )


def unreadable_set(ref: str, error: MapCorrupt) -> VislocError:
    """``map.in_set``, because a current set cannot be read."""
    return refuse(
        "map.in_set",
        f"{ref} is a current set that cannot be read, so its tiles are unknown; first "
        "publish it again or remove it",
        field="map",
        expected="sets that can be read",
        got=f"{error.message}: {error.field}",
    )

"""What a store refuses so that a set and its tiles stay consistent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from visloc.archive.schema import FingerprintRecord, Manifest
from visloc.archive.set_schema import SetManifest
from visloc.errors import Conflict, MapCorrupt, NotFound

AnyManifest = Manifest | SetManifest
# Yields the manifests of (id, version) in order; raises NotFound for a missing one.
ReadManifests = Callable[[Sequence[tuple[str, str]]], Iterator[AnyManifest]]


def refuse_other_kind(incoming: AnyManifest, published: AnyManifest | None) -> None:
    """Refuse a set under the id of a map, and a map under that of a set.

    Args:
        incoming: the version to be published.
        published: any version of the same id in the store; None if there is none.

    Raises:
        Conflict: ``set.id_is_map``, ``map.id_is_set``.
    """
    if published is None or isinstance(published, SetManifest) == isinstance(incoming, SetManifest):
        return
    if isinstance(incoming, SetManifest):
        code, is_now, other = "set.id_is_map", "a map", "set"
    else:
        code, is_now, other = "map.id_is_set", "a set", "map"
    raise Conflict(
        code,
        f"{is_now} has this id already; give the {other} another one",
        field="map",
        expected=f"an id that {is_now} does not have",
        got=incoming.id,
    )


def refuse_missing_tiles(incoming: AnyManifest, read_manifests: ReadManifests) -> None:
    """Refuse a set unless the store has each of its tiles with the content that the set names.

    Raises:
        NotFound: ``set.tile``: a tile is missing.
        Conflict: ``set.tile``: a tile is a set, or another map; ``set.features``: it has other
            local features than the set, so that one extraction does not serve all tiles.
    """
    if not isinstance(incoming, SetManifest):
        return
    manifests = read_manifests([(tile.map, tile.version) for tile in incoming.tiles])
    for tile in incoming.tiles:
        try:
            found = next(manifests)
        except NotFound as error:
            raise NotFound(
                "set.tile",
                "a tile of the set is not in this store; publish it first",
                field="tiles",
                expected=tile.ref,
                got=error.message,
            ) from error
        if isinstance(found, SetManifest) or found.content_hash != tile.content_hash:
            raise Conflict(
                "set.tile",
                "a tile of the set is another one in this store; make the set anew",
                field="tiles",
                expected=f"{tile.ref}, a map of content hash {tile.content_hash}",
                got="a set" if isinstance(found, SetManifest) else found.content_hash,
            )
        refuse_other_features(tile.ref, found.local_features.fingerprint, incoming.local_features)


def refuse_other_features(ref: str, found: FingerprintRecord, expected: FingerprintRecord) -> None:
    """Refuse a tile whose local features differ from those of the set.

    Raises:
        Conflict: ``set.features``.
    """
    if found != expected:
        raise Conflict(
            "set.features",
            f"{ref} has other local features than the set; build all of its maps with the same",
            field="tiles",
            expected=str(expected),
            got=str(found),
        )


def refuse_if_tile(map_id: str, version: str, current: Iterable[tuple[str, AnyManifest]]) -> None:
    """Refuse to remove a version that a set in use names.

    Args:
        map_id: the map.
        version: the version that is to be removed.
        current: references and manifests of the versions in use.

    Raises:
        Conflict: ``map.in_set``.
    """
    for ref, manifest in current:
        if isinstance(manifest, SetManifest) and any(
            (tile.map, tile.version) == (map_id, version) for tile in manifest.tiles
        ):
            raise Conflict(
                "map.in_set",
                "the version is a tile of a set in use; publish the set without it first",
                field="map",
                expected=f"a version that {ref} does not name",
                got=f"{map_id}@{version}",
            )


def unreadable_set(ref: str, error: MapCorrupt) -> Conflict:
    """``map.in_set``, because a set in use cannot be read."""
    return Conflict(
        "map.in_set",
        f"{ref} is a set in use that cannot be read, so that nobody knows its tiles; publish it "
        "anew, or remove it first",
        field="map",
        expected="sets that can be read",
        got=f"{error.message}: {error.field}",
    )

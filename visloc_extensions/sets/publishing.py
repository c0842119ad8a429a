"""Publishing sets of maps: where each map lies, and the coarse index over all of them."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.maps.editing import moved_anchor
from mapping.own_test.verdict import misses_own_photos
from mapping.progress import one_step
from mapping.stages.publishing import new_version
from visloc.archive import (
    Anchor,
    FingerprintRecord,
    Map,
    MapStore,
    SetManifest,
    SetWorld,
    SimilarityRecord,
    TileRecord,
)
from visloc.archive.checks import read_any_manifest
from visloc.archive.places import enu_of, origin_of
from visloc.archive.schema import Extent, Geodetic
from visloc.archive.set_rules import refuse_other_features
from visloc.archive.store import open_published
from visloc.archive.version_rules import checked_name
from visloc.errors import MapCorrupt, NotFound, refuse
from visloc.geodesy import ecef_from_geodetic, geodetic_from_enu
from visloc.geometry import Similarity
from visloc.localization.map_view.constraints import MapGeometry
from visloc.priors import MAX_TILES
from visloc.retrieval.inverted import MadeLists
from visloc_extensions.sets.coarse import (
    CoarseModel,
    coarse_index,
    described,
    descriptors_of,
)
from visloc_extensions.sets.coarse_model import learn
from visloc_extensions.sets.files import CoarseIndex, SetContent, joined_extent, write_set
from visloc_extensions.sets.mistaken import mistaken_for

# Largest difference of scale between metric maps of one set: as well as fits to positions tell it.
_MAX_SCALE_DIFFERENCE = 0.02
# The down directions of two maps, rotated into the set's frame, differ by at most this.
_MAX_DOWN_DIFFERENCE = math.radians(5.0)
# A map's own anchor and its pose in the set differ by at most this. Among houses, satellites locate
# a receiver to about 10 m.
_MAX_PLACE_DIFFERENCE_M, _MAX_PLACE_SHARE = 20.0, 0.05
_BLOCK_ROWS = 2**20

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A map as a tile.

    Attributes:
        metric: whether its own unit is a metre.
        down: (3,) in the set's frame; None where the map does not know it.
        anchor: what its world rests on, in the set's frame.
        doubts: what its own test says against it.
    """

    record: TileRecord
    features: FingerprintRecord
    metric: bool
    down: NDArray[np.float64] | None
    anchor: Anchor | None
    doubts: tuple[str, ...]


def publish_set(
    store: MapStore,
    set_id: str,
    tiles: Sequence[tuple[str, Similarity]],
    progress: Progress,
    *,
    notes: Sequence[str] = (),
    model: CoarseModel | None = None,
) -> Path:
    """Publish a set of maps of a store as the current version of a set.

    What the set knows of its frame:

    - It is metric if its metric maps keep their unit. Without metric maps, it is metric if its
      frame is tied to the Earth with a metre as its unit.
    - It knows down if all of its maps do.
    - It knows where it lies on Earth if one of its maps does. The first of these counts.

    Args:
        set_id: the set's id.
        tiles: ``id`` or ``id@version`` of each map, and where it lies in the set's frame.
        notes: what should be known of the set.
        model: of a coarse index whose tiles had the same local features; None to learn one.

    Returns:
        The folder of the version; of the current one when that is the same set already.
    """
    checked_name(set_id, "set")
    _refuse_number(len(tiles))
    refuse_map_of_this_name(store, set_id, "ID")
    folders = [store.folder(ref) for ref, _ in tiles]
    _refuse_twice(folders)
    placed = []
    progress("tiles", 0, len(tiles))
    for number, (folder, (_, set_from_tile)) in enumerate(zip(folders, tiles, strict=True), 1):
        placed.append(_placed(open_published(folder), set_from_tile))
        refuse_other_features(placed[-1].record.ref, placed[-1].features, placed[0].features)
        progress("tiles", number, len(tiles))
    world = _world(placed)
    if model is None:
        with one_step(progress, "coarse model"):
            model = learn(lambda tile: open_published(folders[tile]), len(folders))
    with store.incoming() as scratch:
        coarse = coarse_index(_described(folders, model, progress), model, scratch / "lists")
        with one_step(progress, "look-alikes"):
            records = _with_look_alikes(folders, [one.record for one in placed], coarse)
        content = SetContent(
            world=world,
            local_features=placed[0].features,
            tiles=records,
            coarse=coarse,
            notes=(*notes, *_warnings(records), *(note for one in placed for note in one.doubts)),
        )
        return _publish_changed(store, set_id, content)


def _refuse_number(num_tiles: int) -> None:
    if not num_tiles:
        raise refuse("set.tiles", "there are no maps", field="MAP", expected="one or more")
    if num_tiles > MAX_TILES:
        raise refuse(
            "set.tiles",
            "there are too many maps",
            field="MAP",
            expected=f"at most {MAX_TILES}",
            got=num_tiles,
        )


def refuse_map_of_this_name(store: MapStore, set_id: str, field: str) -> None:
    """Refuse the id of a map for a set, before the long part."""
    with suppress(NotFound, MapCorrupt):
        if not isinstance(read_any_manifest(store.folder(set_id)), SetManifest):
            raise refuse("set.id_is_map", field=field, got=set_id)


def _refuse_twice(folders: Sequence[Path]) -> None:
    for folder, count in Counter(folders).items():
        if count > 1:
            raise refuse(
                "set.tiles",
                "a map is named twice; a second place in the set requires another map",
                field="MAP",
                expected="each version of a map once",
                got=f"{folder.parent.name}@{folder.name}",
            )


def _publish_changed(store: MapStore, set_id: str, content: SetContent) -> Path:
    prefix, created = new_version()
    with store.incoming() as incoming:
        version = write_set(incoming, content, set_id=set_id, version=prefix, created=created)
        with suppress(NotFound, MapCorrupt):  # there is none, or it is to be replaced
            current = store.folder(set_id)
            if same_content(current, incoming):
                return current
        return store.publish(incoming, set_id, version)


def same_content(a: Path, b: Path) -> bool:
    """Tell whether two folders hold the same map or set, apart from name and version."""
    return read_any_manifest(a).content_hash == read_any_manifest(b).content_hash


def _described(
    folders: Sequence[Path], model: CoarseModel, progress: Progress
) -> Iterator[MadeLists]:
    progress("coarse index", 0, len(folders))
    for number, folder in enumerate(folders, 1):
        yield described(descriptors_of(open_published(folder), model), model)
        progress("coarse index", number, len(folders))


def _placed(opened: Map, set_from_tile: Similarity) -> _Placed:
    manifest, geometry = opened.manifest, MapGeometry(opened)
    centers = set_from_tile.apply(geometry.centers + geometry.origin)
    boxes = [_box(centers)]
    for start in range(0, len(opened.landmarks), _BLOCK_ROWS):
        some = opened.landmarks[start : start + _BLOCK_ROWS].astype(np.float64)
        boxes.append(_box(set_from_tile.apply(some + geometry.origin)))
    record = TileRecord(
        map=manifest.id,
        version=manifest.version,
        content_hash=manifest.content_hash,
        set_from_tile=SimilarityRecord.of(set_from_tile),
        extent=joined_extent(boxes),
        photo_extent=boxes[0],
        reach=set_from_tile.scale * geometry.reach,
        images=manifest.counts.images,
        landmarks=manifest.counts.landmarks,
        size_bytes=opened.size_bytes,
        misses_own_photos=misses_own_photos(manifest.parts.own_test),
    )
    anchor = manifest.world.anchor
    return _Placed(
        record=record,
        features=manifest.local_features.fingerprint,
        metric=manifest.world.metric,
        down=None if opened.gravity is None else set_from_tile.rotation @ opened.gravity,
        anchor=None if anchor is None else moved_anchor(anchor, set_from_tile),
        doubts=tuple(f"{opened.ref} is in doubt: {each.message}" for each in manifest.parts.doubts),
    )


def _with_look_alikes(
    folders: Sequence[Path], records: Sequence[TileRecord], coarse: CoarseIndex
) -> tuple[TileRecord, ...]:
    boxes = np.array([(each.photo_extent.min, each.photo_extent.max) for each in records])
    found = mistaken_for(lambda tile: open_published(folders[tile]), boxes, coarse)
    return tuple(
        each.model_copy(update={"mistaken_for": tuple(records[row].ref for row in rows)})
        for each, rows in zip(records, found, strict=True)
    )


def _warnings(records: Sequence[TileRecord]) -> list[str]:
    """Say which tiles are too poor to tell their photos from those of others."""
    return [
        f"photos of {each.ref} look more like those of {', '.join(each.mistaken_for)}: queries "
        "there are often refused as ambiguous; map it with more photos, or send priors"
        for each in records
        if each.mistaken_for
    ]


def _box(points: NDArray[np.float64]) -> Extent:
    return Extent(min=points.min(axis=0).tolist(), max=points.max(axis=0).tolist())


def _world(placed: Sequence[_Placed]) -> SetWorld:
    anchor = next((one.anchor for one in placed if one.anchor and one.anchor.geodetic), None)
    if anchor is not None and anchor.geodetic is not None:
        _refuse_other_place(placed, anchor.geodetic)
    down = _down(placed)
    return SetWorld.model_validate(
        {
            "metric": _is_metric(placed, anchor),
            "extent": joined_extent([one.record.extent for one in placed]),
            "anchor": anchor,
            "gravity": None if down is None else down.tolist(),
        }
    )


def _refuse_other_place(placed: Sequence[_Placed], geodetic: Geodetic) -> None:
    """Refuse maps whose anchors put their photos elsewhere on Earth than the set's does."""
    for one in placed:
        own = None if one.anchor is None else one.anchor.geodetic
        if own is None:
            continue
        box = one.record.photo_extent
        corners = np.array(list(itertools.product(*zip(box.min, box.max, strict=True))))
        there, here = (
            ecef_from_geodetic(geodetic_from_enu(enu_of(corners, by), origin_of(by)))
            for by in (own, geodetic)
        )
        away = float(np.linalg.norm(there - here, axis=1).max())
        size = geodetic.scale * float(np.linalg.norm(np.subtract(box.max, box.min)))
        if away > max(_MAX_PLACE_DIFFERENCE_M, _MAX_PLACE_SHARE * size):
            raise refuse(
                "set.anchor",
                field="MAP",
                expected=f"at most {_MAX_PLACE_DIFFERENCE_M:g} m, or {_MAX_PLACE_SHARE:.0%} of its "
                "extent, away",
                got=f"{away:.4g} m",
                ref=one.record.ref,
            )


def _is_metric(placed: Sequence[_Placed], anchor: Anchor | None) -> bool:
    scales = {one.record.set_from_tile.scale: one.record.ref for one in placed if one.metric}
    if not scales:
        geodetic = None if anchor is None else anchor.geodetic
        return geodetic is not None and abs(geodetic.scale - 1) <= _MAX_SCALE_DIFFERENCE
    least, most = min(scales), max(scales)
    if most > least * (1 + _MAX_SCALE_DIFFERENCE):
        raise refuse(
            "set.scale",
            field="MAP",
            got=f"{least:g} and {most:g}",
            first=scales[least],
            second=scales[most],
        )
    return abs(least - 1) <= _MAX_SCALE_DIFFERENCE


def _down(placed: Sequence[_Placed]) -> NDArray[np.float64] | None:
    """Down in the set's frame, the mean of what all maps say; None unless all know it."""
    downs = [one.down for one in placed if one.down is not None]
    if len(downs) < len(placed):
        return None
    mean = np.sum(downs, axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    for one, down in zip(placed, downs, strict=True):
        angle = math.acos(float(np.clip(down @ mean, -1, 1)))
        if angle > _MAX_DOWN_DIFFERENCE:
            raise refuse(
                "set.gravity",
                field="MAP",
                expected=f"at most {math.degrees(_MAX_DOWN_DIFFERENCE):g} degrees from their mean",
                got=f"{math.degrees(angle):.3g} degrees",
                ref=one.record.ref,
            )
    return np.asarray(mean)

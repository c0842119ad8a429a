"""The job of ``mapping merge``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapping.maps.cameras import origins_record
from mapping.maps.editing import content_of, joined, moved, refuse_other_features, same_model
from mapping.own_test.publishing import publish_edited, refuse_not_accepted
from mapping.pipeline.pieces import without_pieces
from mapping.stages.publishing import photo_files, sole_publisher
from visloc.archive import GlobalFeatures, Map, MapContent, MapStore
from visloc.archive.schema import ID_PATTERN
from visloc.errors import refuse
from visloc.geometry import Similarity
from visloc.retrieval.fusion import EQUAL_GHARM
from visloc_extensions.living_maps.merging.registration import Registration, register, updates_of
from visloc_extensions.sets.publishing import publish_set

# Least part of the photos of B that must be tied to A.
MIN_OVERLAP = 0.1

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The result of a merge.

    Attributes:
        a: the map whose frame it has.
        notes: what was left out, one sentence each.
    """

    folder: Path
    a: Map
    b: Map
    registration: Registration
    notes: tuple[str, ...]


def merge_maps(
    store: MapStore,
    a_ref: str,
    b_ref: str,
    map_id: str,
    progress: Progress,
    *,
    min_overlap: float = MIN_OVERLAP,
    accept: bool = False,
) -> Merged:
    """Publish one map of two that overlap, in the frame of the first; both stay.

    Args:
        map_id: of the new map; there must be none of this name.
        progress: told the stage, how much is done, and how much there is.
        min_overlap: least part of the photos of B that must be tied to A.
        accept: put it into use even if its own test speaks against it, or spoke against one of
            the two.
    """
    _refuse_name(store, map_id)
    a, b = _opened(store, a_ref, b_ref, min_overlap)
    if not accept:
        for opened in (a, b):
            refuse_not_accepted(store, opened)
    with sole_publisher(store.root, map_id):
        first, second = content_of(a), content_of(b)
        refuse_other_features(first, second)
        joined(_alike(first), _alike(second))  # refuses early
        found = register(a, b, min_overlap, progress)
        second = moved(second, found.tie.there_from_here, metric=first.metric)
        content, pictures, notes = _joined(a, b, first, second, found)
        _refuse_name(store, map_id)  # one may have been uploaded meanwhile
        folder = publish_edited(
            store, content, map_id, photos=pictures, accept=accept, progress=progress
        )
        return Merged(folder, a, b, found, notes)


def join_as_set(
    store: MapStore,
    a_ref: str,
    b_ref: str,
    set_id: str,
    progress: Progress,
    *,
    min_overlap: float = MIN_OVERLAP,
) -> Merged:
    """Publish a set of two maps that overlap, in the frame of the first.

    Arguments and errors are those of ``merge_maps``, except that photos may have equal names. Also
    raises the errors of ``publish_set``.
    """
    _refuse_name(store, set_id)
    a, b = _opened(store, a_ref, b_ref, min_overlap)
    with sole_publisher(store.root, set_id):
        refuse_other_features(content_of(a), content_of(b))
        found = register(a, b, min_overlap, progress)
        _refuse_name(store, set_id)  # one may have been made meanwhile
        tiles = [(a.ref, Similarity.identity()), (b.ref, found.tie.there_from_here)]
        note = _note(b, found)
        folder = publish_set(store, set_id, tiles, progress, notes=(note,))
        return Merged(folder, a, b, found, ())


def _refuse_name(store: MapStore, new_id: str) -> None:
    """Refuse what is no name, or that of a map or a set that there is."""
    if not ID_PATTERN.fullmatch(new_id):
        raise refuse(
            "map.id",
            field="--map",
            expected="up to 64 letters, digits, '.', '_', '-', beginning with a letter or digit",
            got=new_id,
        )
    if new_id in store.ids():
        raise refuse("map.exists", field="--map", got=new_id)


def _opened(store: MapStore, a_ref: str, b_ref: str, min_overlap: float) -> tuple[Map, Map]:
    if not 0 < min_overlap <= 1:
        raise refuse("merge.min_overlap", field="--min-overlap", got=min_overlap)
    a, b = store.open(a_ref), store.open(b_ref)
    if a.ref == b.ref:
        raise refuse("merge.same", field="MAP", got=a.ref)
    return a, b


def _alike(content: MapContent) -> MapContent:
    """A map without what is made equal before joining."""
    return replace(content, global_features=())


def _joined(
    a: Map, b: Map, first: MapContent, second: MapContent, found: Registration
) -> tuple[MapContent, list[Path], tuple[str, ...]]:
    """The map of both, in one frame, with its small pictures and notes on what is left out."""
    kept, dropped = _global_features(first, second, found.described)
    left_out = [
        f"{name} left out: both maps have it of their own, and it is made of the photos, which "
        "maps do not keep"
        for name in dropped
    ]
    pictures = photo_files(a), photo_files(b)
    if bool(pictures[0]) != bool(pictures[1]):
        left_out.append("small pictures left out: one of the maps has none")
    content = joined(_alike(first), _alike(second))
    weights = first.fusion.weights
    names = {one.fingerprint.name for one in kept}
    fused = weights is None or set(weights) <= names
    updates = [*updates_of(first.settings), *updates_of(second.settings)]
    nothing_placed = first.anchor is None or first.anchor.geodetic is None
    on_earth = second.anchor is not None and second.anchor.geodetic is not None
    content = replace(
        content,
        method=first.method if first.method == second.method else "merged",
        settings={
            **without_pieces(first.settings),
            **origins_record(a, b, content.images),
            **({"updates": updates} if updates else {}),
        },
        notes=(*content.notes, _note(b, found), *left_out),
        global_features=kept,
        fusion=first.fusion if fused else EQUAL_GHARM,
        anchor=second.anchor if nothing_placed and on_earth else first.anchor,
        # What A knows may be its anchor's.
        gravity=second.gravity if a.gravity is None else first.gravity,
    )
    all_kept = [*pictures[0], *pictures[1]] if all(pictures) else []
    return content, all_kept, tuple(left_out)


def _global_features(
    first: MapContent, second: MapContent, described: GlobalFeatures
) -> tuple[tuple[GlobalFeatures, ...], list[str]]:
    """Join the global features that both maps computed with the same model.

    If there are none, return those that were learned from both maps together.

    Returns:
        The features of all photos, and the names of those that are left out.
    """
    others = {one.fingerprint.name: one for one in second.global_features}
    kept = [
        replace(one, descriptors=np.concatenate([one.descriptors, other.descriptors]))
        for one in first.global_features
        if (other := others.get(one.fingerprint.name)) is not None and same_model(one, other)
    ]
    names = {one.fingerprint.name for one in kept}
    if described.fingerprint.name not in names:
        kept.append(described)
        names.add(described.fingerprint.name)
    all_names = dict.fromkeys(
        one.fingerprint.name for one in (*first.global_features, *second.global_features)
    )
    return tuple(kept), [name for name in all_names if name not in names]


def _note(b: Map, found: Registration) -> str:
    tied = found.tie.tied
    return (
        f"{b.ref} was registered by {tied.sum()} of {found.tried} photos, with a median "
        f"reprojection error of {np.median(found.tie.errors_px[tied]):.2f} px"
    )

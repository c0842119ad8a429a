"""The job of ``mapping prune``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from mapping.maps.editing import content_of, selected
from mapping.methods.retrieval_only import refuse_without_landmarks
from mapping.own_test.publishing import publish_tested, write_content
from mapping.stages.publishing import link_photos, photo_files, successor_of
from visloc.archive import Map, MapContent, MapStore, open_map
from visloc.errors import refuse
from visloc_extensions.living_maps.pruning.accuracy import Accuracy, of_held_out_photos
from visloc_extensions.living_maps.pruning.choosing import (
    LEFT_OUT,
    Kept,
    choose,
    least,
    num_landmarks,
    size_with,
)

Measure = Callable[[Map, Map], tuple[Accuracy, Accuracy]]


@dataclass(frozen=True, slots=True, eq=False)
class Pruned:
    """A smaller version of a map.

    Attributes:
        before: the version that it was made of.
    """

    before: Map
    after: Map
    accuracy: tuple[Accuracy, Accuracy]


def prune_map(
    store: MapStore,
    map_ref: str,
    *,
    max_bytes: int | None = None,
    max_landmarks: int | None = None,
    measure: Measure | None = None,
    accept: bool = False,
    progress: Callable[[str, int, int], None],
) -> Pruned:
    """Publish a version of a map that is as large as it may be; the one before stays.

    Args:
        max_bytes: most that its files take, manifest aside; or None.
        max_landmarks: most landmarks; or None.
        measure: compares the accuracy of both versions; None: by photos of the map.
        accept: put it into use even if its own test speaks against it.
        progress: told the stage, how much is done, and how much there is.
    """
    before = store.open(map_ref)
    refuse_without_landmarks(before)
    map_id, named = before.manifest.id, before.manifest.version
    with successor_of(before, store):
        progress("choosing", 0, 1)
        kept = keep_within(before, max_bytes, max_landmarks)
        progress("choosing", 1, 1)
        content = selected(content_of(before), kept.images, observations=kept.observations)
        content = _noted(before, content)
        with store.incoming() as incoming:
            pictures = photo_files(before)
            link_photos(
                incoming,
                [path for path, stays in zip(pictures, kept.images, strict=True) if stays]
                if pictures
                else [],
            )
            doubts = before.manifest.parts.doubts
            version = write_content(incoming, content, map_id, carried=doubts, progress=progress)
            # Measured before anybody is served it.
            after = open_map(incoming)
            told = partial(progress, "before and after")
            accuracy = (
                of_held_out_photos(before, after, kept, told)
                if measure is None
                else measure(before, after)
            )
            folder = publish_tested(store, incoming, map_id, version, based_on=named, accept=accept)
        return Pruned(before, open_map(folder), accuracy)


def keep_within(opened: Map, max_bytes: int | None, max_landmarks: int | None) -> Kept:
    """Choose what stays of a map; see ``prune_map`` for errors."""
    size, count = opened.size_bytes, len(opened.landmarks)
    if (max_bytes is None or size <= max_bytes) and (
        max_landmarks is None or count <= max_landmarks
    ):
        raise refuse(
            "prune.small_already",
            field="--max-bytes" if max_landmarks is None else "--max-landmarks",
            expected=f"less than {size} bytes" if max_landmarks is None else f"less than {count}",
            got=max_bytes if max_landmarks is None else max_landmarks,
        )

    def fits(kept: Kept) -> bool:
        if max_bytes is not None and size_with(opened, kept) > max_bytes:
            return False
        return max_landmarks is None or num_landmarks(opened, kept) <= max_landmarks

    whole = max_bytes is None
    kept = choose(opened, fits, whole_landmarks=whole)
    if kept is not None:
        return kept
    smallest = least(opened, whole_landmarks=whole)
    if max_bytes is not None and size_with(opened, smallest) > max_bytes:
        fixed = sum(
            entry.size
            for name, entry in opened.manifest.files.items()
            if name.endswith(".model.npz") or name == "cameras.json"
        )
        raise refuse(
            "prune.too_small",
            f"the models of the global features alone take {fixed} bytes, which leaves no "
            "room for photos or landmarks",
            field="--max-bytes",
            expected=f"at least {size_with(opened, smallest)}",
            got=max_bytes,
        )
    raise refuse(
        "prune.too_small",
        field="--max-landmarks",
        expected=f"at least {num_landmarks(opened, smallest)}",
        got=max_landmarks,
    )


def _noted(before: Map, content: MapContent) -> MapContent:
    """Say in the map that it is a part, and of what."""
    counts = before.manifest.counts
    gone = [name for name in LEFT_OUT if name in before.manifest.files]
    note = (
        f"pruned from version {before.manifest.version}, which has {counts.images} photos, "
        f"{counts.landmarks} landmarks and {counts.observations} observations"
        + (f"; {' and '.join(gone)} left out" if gone else "")
    )
    return replace(content, notes=(*content.notes, note))

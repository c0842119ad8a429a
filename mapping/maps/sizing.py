"""``mapping edit``: a known length gives a finished map its size."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapping.frames.anchor import MAX_SCALE_ERROR
from mapping.frames.known_length import KnownLength, photo_named, scale_of_length
from mapping.maps.editing import content_of, moved
from mapping.methods.sfm import UNPLACED
from mapping.own_test.held_out import doubts_of_length
from mapping.own_test.publishing import publish_tested, write_content
from mapping.own_test.verdict import has_estimated_poses
from mapping.progress import Progress
from mapping.stages.imported_points import read_imported_points
from mapping.stages.publishing import PAIRS, link_photos, photo_files, successor_of
from visloc.archive import Map, MapStore
from visloc.archive.anchoring import link_or_copy
from visloc.errors import refuse
from visloc.geometry import Pose, Similarity


def publish_sized(
    opened: Map,
    length: KnownLength,
    maps_dir: Path,
    *,
    force: bool,
    accept: bool,
    progress: Progress,
) -> Map:
    """Publish a map in metres, as the distance of two of its photos tells them, as a new version.

    Everything is scaled about the world's (0, 0, 0). Where photos placed each other, there is a
    doubt if the two do not come back where they are.

    Args:
        force: measure a map anew that is in metres already.
        accept: put the version into use whatever speaks against it.
    """
    manifest, geodetic = opened.manifest, opened.geodetic
    if manifest.world.metric and not force:
        raise refuse("edit.metric", field="--force", ref=opened.ref)
    names = [image.name for image in opened.images]
    first, second = (photo_named(text, names) for text in length.photos)
    poses = (Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses)
    centers = {name: pose.center for name, pose in zip(names, poses, strict=True)}
    scale = scale_of_length(first, second, length.metres, centers)
    if scale.metres is None:
        raise refuse("edit.scale", field="--scale", got=scale.note)
    if geodetic and abs(math.log(geodetic.scale / scale.metres)) > 2 * MAX_SCALE_ERROR:
        raise refuse(
            "edit.scale",
            "the length contradicts the map's place on Earth",
            field="--scale",
            expected=f"a unit of {geodetic.scale:.4g} m to within {2 * MAX_SCALE_ERROR:.0%}",
            got=f"a unit of {scale.metres:.4g} m",
        )
    units = Similarity(scale.metres, np.eye(3), np.zeros(3))
    content = moved(content_of(opened), units, metric=True)
    content = replace(
        content,
        settings={**content.settings, "scale": dict(scale.record)},
        notes=(*(note for note in content.notes if note != UNPLACED), scale.note),
    )
    # A doubt about the length that told the size before is settled.
    doubts = [doubt for doubt in manifest.parts.doubts if doubt.kind != "scale"]
    if has_estimated_poses(opened):
        doubts += doubts_of_length(opened, (first, second))
    store = MapStore(maps_dir)
    with successor_of(opened, store), store.incoming() as incoming:
        link_photos(incoming, photo_files(opened))
        if PAIRS in manifest.files:
            link_or_copy(opened.path / PAIRS, incoming / PAIRS)
        if (imported := read_imported_points(opened)) is not None:
            replace(imported, points=units.apply(imported.points)).write(incoming)
        map_id, based_on = manifest.id, manifest.version
        version = write_content(incoming, content, map_id, carried=doubts, progress=progress)
        publish_tested(store, incoming, map_id, version, based_on=based_on, accept=accept)
    return store.open(f"{map_id}@{version}")

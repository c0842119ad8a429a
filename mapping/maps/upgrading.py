"""Adding to maps of older formats what needs no photos."""

from __future__ import annotations

from pathlib import Path

from mapping.own_test.trials import own_test
from mapping.stages.publishing import new_version, successor_of
from visloc.archive import Map, MapStore, write_tested
from visloc.errors import refuse
from visloc.retrieval.index import MAX_EXACT


def upgrade_map(opened: Map, maps_dir: Path) -> Path:
    """Publish a map with its own test, and with an index if it is large, as a new version.

    The new version becomes current. Landmarks, photos and features stay as they are; both versions
    share their files.

    Returns:
        The folder of the new version.
    """
    test = opened.manifest.parts.own_test
    had_one = any(record.clusters is not None for record in opened.manifest.global_features)
    indexed = not opened.has_index and (had_one or len(opened.images) > MAX_EXACT)
    if test is not None and not indexed:
        raise refuse("map.upgraded", field="MAP", ref=opened.ref)
    map_id, based_on = opened.manifest.id, opened.manifest.version
    store = MapStore(maps_dir)
    with successor_of(opened, store), store.incoming() as incoming:
        version, created = new_version()
        version = write_tested(
            opened,
            incoming,
            own_test(opened) if test is None else test,
            version=version,
            created=created,
            indexed=indexed,
        )
        return store.publish(incoming, map_id, version, based_on=based_on)


def lacking(opened: Map) -> list[str]:
    """Say what newer formats have that only a new build from the photos can give a map."""
    missing = []
    if opened.manifest.local_features.keypoint_step_px is None:
        missing.append("keypoints and global descriptors stay in 32 bits: the map is larger")
    if opened.manifest.local_features.computed_with is None:
        missing.append("what computed the features stays unknown")
    if opened.manifest.world.anchor is None:
        missing.append("what position, orientation and scale rest on stays unknown")
    from_depth = opened.manifest.method.name == "rgbd"
    if not from_depth and "landmark_angle_deg.npy" not in opened.manifest.files:
        missing.append("the angles between viewing rays stay unknown")
    return [f"only a new build from the photos can add this: {text}" for text in missing]

"""Maps without landmarks grow, join and are not pruned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.mapping.pipeline.test_retrieval_only import quiet
from visloc.archive import Map, MapStore, open_map, verify_map
from visloc.errors import Conflict
from visloc.kapture import read_dataset, write_dataset
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.living_maps.merging import merge_maps
from visloc_extensions.living_maps.pruning import prune_map
from visloc_extensions.living_maps.updating import UpdateSettings, update_map


def test_what_needs_landmarks_is_refused(bare: Map, walk: Path) -> None:
    ref, root = bare.manifest.id, bare.path.parents[1]
    attempts: list[Callable[[], object]] = [
        lambda: prune_map(
            MapStore(root), ref, max_bytes=100_000, max_landmarks=None, progress=quiet
        ),
        lambda: update_map(UpdateSettings(ref, walk / "mapping", root, method="sfm"), quiet),
    ]
    for attempt in attempts:
        with pytest.raises(Conflict) as caught:
            attempt()
        assert caught.value.code == "map.no_landmarks"


def _part(dataset: Path, folder: Path, rows: Sequence[int]) -> Path:
    """Copy a dataset with the photos of some instants alone."""
    whole = read_dataset(dataset)
    times = sorted({record.timestamp for record in whole.images})
    chosen = {times[row] for row in rows}
    images = tuple(record for record in whole.images if record.timestamp in chosen)
    write_dataset(replace(whole, root=folder, images=images, depth_maps=(), gnss=()))
    for record in images:
        link = folder / "sensors" / "records_data" / record.path
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(whole.path_of(record).resolve())
    return folder


@pytest.mark.slow
def test_photos_join_one_by_one_where_they_were_taken(
    walk: Path, build_walk: Callable[..., Map], tmp_path: Path
) -> None:
    dataset = read_dataset(walk / "mapping")
    rest = [row for row in range(8) if row not in (3, 5)]
    first = _part(walk / "mapping", tmp_path / "first", rest)
    before = build_walk(first, tmp_path / "maps", method="retrieval-only", max_keypoints=1000)
    truth = {record.path: dataset.pose(record) for record in dataset.images}
    for instant, poses, most in ((3, "given", 1e-9), (5, "localize", 0.1)):
        new = _part(walk / "mapping", tmp_path / poses, [instant])
        settings = UpdateSettings(before.manifest.id, new, tmp_path / "maps", poses=poses)
        after = open_map(update_map(settings, quiet).folder)
        assert verify_map(after.path).has_landmarks is False
        counts, old = after.manifest.counts, before.manifest.counts
        assert counts.images == old.images + 2  # the rig has two cameras
        assert after.observation_landmarks.tolist() == list(range(counts.observations))
        np.testing.assert_array_equal(after.keypoints(0), before.keypoints(0))
        geometry = MapGeometry(after)
        for row in range(old.images, counts.images):
            pose = truth[after.images[row].name]
            assert pose is not None
            assert np.linalg.norm(geometry.viewpoints.pose(row).center - pose.center) < most
            assert len(geometry.observed(row)[0]) > 50  # triangulated with those that were there
        before = after
    updates = before.manifest.method.settings["updates"]
    assert [(one["method"], one["photos"]) for one in updates] == [("retrieval-only", 2)] * 2  # type: ignore[union-attr,index,call-overload]


@pytest.mark.slow
def test_two_maps_without_landmarks_merge(
    walk: Path, build_walk: Callable[..., Map], tmp_path: Path
) -> None:
    maps, refs = tmp_path / "maps", []
    for name, instants in (("even", [0, 2, 4, 6]), ("odd", [1, 3, 5])):
        part = _part(walk / "mapping", tmp_path / name, instants)
        refs.append(build_walk(part, maps, method="retrieval-only", max_keypoints=1000).ref)
    merged = merge_maps(MapStore(maps), refs[0], refs[1], "both", quiet, accept=True)
    both = verify_map(merged.folder)
    assert (both.manifest.counts.images, both.manifest.counts.landmarks) == (14, 0)
    # Both maps are in one frame already.
    assert np.abs(merged.registration.tie.there_from_here.translation).max() < 0.05

"""Builds that publish their maps in an S3 server."""

from __future__ import annotations

import shutil
from pathlib import Path

from mapping.cli.acceptance import use
from mapping.cluster.storage import open_store, place_of
from mapping.pipeline.build import build_map
from tests.mapping.cluster.test_storage import objects_of, settings_for
from visloc.archive import Map, open_map


def test_a_build_from_and_to_urls_makes_the_map_of_a_local_build(
    bucket: str, tmp_path: Path, sfm_walk: Map
) -> None:
    maps = place_of(f"{bucket}/{tmp_path.name}/maps", "--maps-dir")
    settings = settings_for(bucket, tmp_path, method="sfm", maps_dir=maps)
    seen: set[str] = set()

    def watch(stage: str, done: int, total: int) -> None:
        if stage == "archive" and done < total:
            seen.update(objects_of(bucket))

    built = open_map(build_map(settings, watch))
    assert built.manifest.content_hash == sfm_walk.manifest.content_hash
    assert sum(f"{tmp_path.name}/maps/.work/walk/local_features/" in name for name in seen) == 16
    left = {name for name in objects_of(bucket) if name.startswith(tmp_path.name)}
    assert not any(".work" in name for name in left)
    published = open_store(maps, tmp_path / "other cache")
    again = open_map(published.folder("walk"))
    assert again.manifest.content_hash == sfm_walk.manifest.content_hash


def test_a_version_at_a_url_is_put_into_use(bucket: str, tmp_path: Path, sfm_walk: Map) -> None:
    maps = place_of(f"{bucket}/{tmp_path.name}/maps", "--maps-dir")
    store, version = open_store(maps, tmp_path / "cache"), sfm_walk.manifest.version
    with store.incoming() as incoming:
        shutil.copytree(sfm_walk.path, incoming / "map")
        store.publish(incoming / "map", "walk", version, make_current=False)

    use(f"walk@{version}", maps, tmp_path / "another cache")

    assert open_store(maps, tmp_path / "other cache").current_version("walk") == version

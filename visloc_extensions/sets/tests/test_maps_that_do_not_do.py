"""Sets of maps without landmarks, and of maps in doubt."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapping.cli.acceptance import use
from tests.mapping.own_test.test_verdict import build
from tests.mapping.pipeline.test_retrieval_only import quiet
from visloc.archive import Map, MapStore
from visloc.errors import Conflict
from visloc.geometry import Similarity
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.sets.files import open_set
from visloc_extensions.sets.publishing import publish_set
from visloc_extensions.sets.splitting import split_map


@pytest.fixture(scope="module")
def store(bare: Map) -> MapStore:
    return MapStore(bare.path.parents[1])


def test_what_needs_landmarks_is_refused(bare: Map, store: MapStore) -> None:
    with pytest.raises(Conflict) as caught:
        split_map(store, bare.manifest.id, "tiles", quiet, tile=2.0, overlap=1.0)
    assert caught.value.code == "map.no_landmarks"


def test_a_set_takes_maps_without_landmarks(bare: Map, store: MapStore) -> None:
    tiles = [(bare.manifest.id, Similarity.identity())]
    opened = open_set(publish_set(store, "tiles", tiles, quiet))
    assert opened.manifest.counts.landmarks == 0
    assert opened.manifest.tiles[0].reach == pytest.approx(MapGeometry(bare).reach)


def test_nothing_is_made_of_a_version_in_doubt_until_it_is_accepted(
    broken: Path, maps_dir: Path
) -> None:
    store = MapStore(maps_dir)
    ref = f"room@{build(broken, maps_dir).manifest.version}"

    with pytest.raises(Conflict) as caught:
        split_map(store, ref, "tiles", lambda *_: None, tile=100.0, overlap=0.0)
    assert caught.value.code == "map.doubtful"
    assert store.ids() == ["room"]

    use(ref, maps_dir)
    split_map(store, ref, "tiles", lambda *_: None, tile=100.0, overlap=0.0)
    assert "tiles" in store.ids()

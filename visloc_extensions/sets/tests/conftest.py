"""Sets made by hand, as their manifests would say them; fixtures of the core's tests."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.mapping.conftest import build_walk, walk  # noqa: F401
from tests.mapping.own_test.test_verdict import broken  # noqa: F401
from tests.mapping.pipeline.test_retrieval_only import bare  # noqa: F401
from tests.service.conftest import in_study, serve, study, two_rooms  # noqa: F401
from tests.visloc.conftest import hall, place  # noqa: F401

if TYPE_CHECKING:
    from visloc.archive import SetOutline

HASH = "0" * 64


def _outline(
    boxes: Any, *, reach: float = 3.0, gravity: Any = None, names: tuple[str, ...] = ()
) -> SetOutline:
    """A set whose tiles have photos in these boxes, [(low, high), ...]."""
    from visloc.archive import SetManifest, SetOutline

    fingerprint = {"name": "sift", "revision": 1, "parameters": {}}
    whole = {"min": (-1e3,) * 3, "max": (1e3,) * 3}
    tiles = [
        {
            "map": names[row] if names else f"tile-{row}",
            "version": f"v{1 + names[:row].count(names[row])}" if names else "v1",
            "content_hash": HASH,
            "set_from_tile": {},
            "extent": {"min": low, "max": high},
            "photo_extent": {"min": low, "max": high},
            "reach": reach,
            "images": 10,
            "landmarks": 20,
            "size_bytes": 30,
        }
        for row, (low, high) in enumerate(boxes)
    ]
    count = len(tiles)
    manifest = SetManifest.model_validate(
        {
            "format": "visloc-set",
            "format_version": "2.0",
            "id": "town",
            "version": "v1",
            "created": "2026-01-02T03:04:05+00:00",
            "world": {"metric": True, "extent": whole, "gravity": gravity},
            "local_features": fingerprint,
            "tiles": tiles,
            "coarse": {"fingerprint": fingerprint, "dim": 8, "lists": 4},
            "counts": {"tiles": count, "images": 10 * count, "landmarks": 20 * count},
            "content_hash": HASH,
            "manifest_hash": HASH,
            "files": {},
        }
    )
    return SetOutline(manifest, np.array(boxes, dtype=np.float64), np.full(count, reach))


@pytest.fixture(scope="session")
def outline() -> Callable[..., SetOutline]:
    """Makes the outline of a set."""
    return _outline


@pytest.fixture(scope="session")
def site(two_rooms: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """Maps ``room``, ``study`` and ``copy``, and sets of them; only to be read."""
    from visloc_extensions.sets.tests.map_sets import write_site

    maps = Path(shutil.copytree(two_rooms, tmp_path_factory.mktemp("site") / "maps"))
    write_site(maps)
    return maps


@pytest.fixture
def site_copy(site: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    return Path(shutil.copytree(site, tmp_path / "maps"))


@pytest.fixture(scope="session")
def upright_site(
    sample: Path,
    study: Path,  # noqa: F811
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """``room``, ``study`` and their set, with features that do not know a turned photo."""
    from visloc_extensions.sets.tests.map_sets import write_upright_site

    maps = tmp_path_factory.mktemp("upright_site")
    write_upright_site(sample, study, maps)
    return maps

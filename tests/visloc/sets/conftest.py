"""Sets made by hand, as their manifests would say them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

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

"""Does a network place keypoints of coarse scales beside those of fine ones? (docs/decisions/0020).

    python -m benchmarks.keypoint_offsets faster2d2 PHOTOS... --weights-dir WEIGHTS

A network that places keypoints d pixels beside what they are of, in the image that it sees, places
them d / s pixels beside it in the photo, where s is the scale of that image. So keypoints that
neighbouring scales find of one corner lie d (1 / s2 - 1 / s1) apart. Prints d as the median over
such pairs.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.spatial import cKDTree

from benchmarks.speed.tables import table
from visloc.features import make_local_features
from visloc.features.networks.r2d2.extractor import PATCH_PX
from visloc.photos.reading import read_photo_file

_MAX_KEYPOINTS = 20_000
# Of the finer scale's pixels: keypoints farther apart are of different corners.
_REACH_PX = 1.5
_LEAST = 20  # keypoints of a scale


def main(
    name: Annotated[str, typer.Argument(help="r2d2 or faster2d2")],
    photos: list[Path],
    weights_dir: Annotated[Path | None, typer.Option(help="folder of network weights")] = None,
) -> None:
    """Measure and print."""
    found: dict[tuple[float, float], list[np.ndarray]] = {}
    features = make_local_features(name, weights_dir)
    for path in photos:
        local = features.extract(read_photo_file(path).rgb, max_keypoints=_MAX_KEYPOINTS)
        assert local.scales is not None
        for fine, coarse in pairwise(sorted(set(local.scales.tolist()))):
            of_fine, of_coarse = (local.keypoints[local.scales == size] for size in (fine, coarse))
            apart = _apart(of_fine, of_coarse, fine)
            found.setdefault((fine, coarse), []).append(apart * PATCH_PX / (coarse - fine))
    by_pair = {pair: np.concatenate(rows) for pair, rows in found.items()}
    rows = [
        [f"{fine:.1f} and {coarse:.1f}", *_row(offsets)]
        for (fine, coarse), offsets in by_pair.items()
    ]
    rows.append(["all", *_row(np.concatenate(list(by_pair.values())))])
    typer.echo("\n".join(table(["patches, px", "pairs", "x, px", "y, px"], rows)))


def _apart(fine: np.ndarray, coarse: np.ndarray, patch: float) -> np.ndarray:
    """How far (n, 2) keypoints of the coarse scale lie from mutual nearest ones of the fine one."""
    if min(len(fine), len(coarse)) < _LEAST:
        return np.empty((0, 2))
    distance, nearest = map(np.asarray, cKDTree(fine).query(coarse))
    back = np.asarray(cKDTree(coarse).query(fine)[1])
    same = (back[nearest] == np.arange(len(coarse))) & (distance < _REACH_PX * patch / PATCH_PX)
    return np.asarray(coarse[same] - fine[nearest[same]], np.float64)


def _row(offsets: np.ndarray) -> list[str]:
    if len(offsets) == 0:
        return ["0", "-", "-"]
    x, y = np.median(offsets, axis=0)
    return [str(len(offsets)), f"{x:+.2f}", f"{y:+.2f}"]


if __name__ == "__main__":
    typer.run(main)

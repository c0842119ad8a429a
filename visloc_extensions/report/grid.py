"""Places to stand and directions to look, over the area that was mapped."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapping.frames.plan import Plan
from visloc.localization.map_view.constraints import Viewpoints
from visloc_extensions.report.model import CoverageModel, Forecast

NUM_DIRECTIONS = 12
_NUM_CELLS = 320
# How far around the mapping photos the grid reaches, of the distance from which they see.
MARGIN_OF_REACH = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Where to stand.

    Attributes:
        side: of a cell, units of the world.
        positions: (c, 3) float64 relative to the map's origin, middles of cells.
        away: (c,) float64, level distance to the nearest mapping photo.
        directions_deg: in which to look at each, from right towards ahead.
    """

    side: float
    positions: NDArray[np.float64]
    away: NDArray[np.float64]
    directions_deg: tuple[float, ...]


def make_grid(plan: Plan, viewpoints: Viewpoints) -> Grid:
    """Lay a grid over the surroundings of the mapping photos, as high as the nearest of them.

    It knows no walls: cells within them are there too.
    """
    photos = plan.level(viewpoints.centers)
    tree = cKDTree(photos)
    margin = MARGIN_OF_REACH * viewpoints.reach
    # By halving an interval: the number of cells falls as they grow, if not quite steadily.
    low, high = 0.01 * margin, max(margin, float(np.ptp(photos, axis=0).max()))
    for _ in range(20):
        side = math.sqrt(low * high)
        if _num_cells(photos, margin, side) > 50 * _NUM_CELLS:
            low = side
            continue
        count = len(_cells(photos, tree, margin, side))
        low, high = (side, high) if count > _NUM_CELLS else (low, side)
    cells = _cells(photos, tree, margin, high)
    away, nearest = tree.query(cells)
    heights = viewpoints.centers[nearest] @ plan.up
    positions = cells @ np.stack([plan.right, plan.ahead]) + heights[:, None] * plan.up
    step = 360.0 / NUM_DIRECTIONS
    return Grid(high, positions, np.asarray(away), tuple(step * i for i in range(NUM_DIRECTIONS)))


def forecast_grid(
    model: CoverageModel, plan: Plan, grid: Grid, progress: Callable[[int, int], None]
) -> list[list[Forecast]]:
    """Forecast a photo at every cell in every direction."""
    forecasts = []
    progress(0, len(grid.positions))
    for done, position in enumerate(grid.positions, 1):
        poses = [plan.pose(position, direction) for direction in grid.directions_deg]
        forecasts.append([model.forecast(pose, plan.camera) for pose in poses])
        progress(done, len(grid.positions))
    return forecasts


def probabilities_of(forecasts: Sequence[Sequence[Forecast]]) -> NDArray[np.float64]:
    """Probabilities (c, d) by cell and direction."""
    return np.array([[forecast.probability for forecast in row] for row in forecasts])


def _num_cells(photos: NDArray[np.float64], margin: float, side: float) -> float:
    """Cells of the box about all photos."""
    return float(np.prod((np.ptp(photos, axis=0) + 2 * margin) / side + 2))


def _cells(
    photos: NDArray[np.float64], tree: cKDTree, margin: float, side: float
) -> NDArray[np.float64]:
    """Middles (c, 2) of the cells within the margin of a photo; whole multiples of the side."""
    first = np.floor((photos.min(axis=0) - margin) / side)
    last = np.ceil((photos.max(axis=0) + margin) / side)
    x, y = (np.arange(a, b + 1) * side for a, b in zip(first, last, strict=True))
    cells = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    away, _ = tree.query(cells, distance_upper_bound=margin * (1 + 1e-9))
    return np.asarray(cells[np.isfinite(away)])

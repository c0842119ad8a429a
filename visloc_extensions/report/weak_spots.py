"""Where to go and which way to look to take more photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapping.frames.plan import Plan
from mapping.own_test.held_out import Within
from visloc_extensions.report.grid import Grid, probabilities_of
from visloc_extensions.report.model import CoverageModel, Forecast

_MOST = 8
_WEAK = 0.5
# Nearer than this to a mapping photo, of the distance from which they see, people walk for sure.
_WALKED_OF_REACH = 0.25
# Queries are likelier the less they differ from mapping photos: by a factor e for each so many
# radians of ``Viewpoints.apart_from``.
_LIKELY_APART = 1.5
# Spots of the same weakness are told once: further apart than any of these, they are others.
_APART_CELLS, _APART_OF_REACH, _APART_DEG = 3.0, 0.25, 60.0
_AROUND_CELLS, _AROUND_DEG = 1.5, 30.0
# What is worth a word: fewer places in view than this part of what mapping photos have; what brings
# so many times the matches if it were better; points nearer together than this, of the picture's
# sides (evenly filled, it is 0.29); a position left open by so much of what is allowed.
_FEW_OF_USUAL, _GAIN, _SPREAD, _OPEN = 0.5, 2.0, 0.15, 0.5
_OCTAVES = 0.4
_MOST_REASONS = 2
_USUAL_PHOTOS = 50


@dataclass(frozen=True, slots=True)
class WeakSpot:
    """A place and a direction to take more photos.

    Attributes:
        direction: row of the grid's directions.
    """

    cell: int
    direction: int
    why: str


def find_weak_spots(
    grid: Grid,
    plan: Plan,
    forecasts: Sequence[Sequence[Forecast]],
    model: CoverageModel,
    within: Within,
    unit: str,
) -> list[WeakSpot]:
    """Find where a query is likely, but not to be localized; the greatest loss first.

    Args:
        plan: its frame.
        unit: of the world, for people, with a blank before it; "" for none.
    """
    viewpoints = model.viewpoints
    usual = _usually_in_view(model, plan)
    chances = probabilities_of(forecasts)
    level = plan.level(grid.positions)
    directions = np.array(grid.directions_deg)
    turns = np.abs((directions[:, None] - directions + 180.0) % 360.0 - 180.0)
    around = turns <= _AROUND_DEG
    # A weak direction among good ones needs a photo less than one of many: means of surroundings.
    means = np.empty_like(chances)
    for cell, position in enumerate(level):
        near = np.linalg.norm(level - position, axis=1) <= _AROUND_CELLS * grid.side
        means[cell] = chances[near].mean(axis=0) @ around / around.sum(axis=0)
    walked = grid.away <= _WALKED_OF_REACH * viewpoints.reach
    if not walked.any():  # cells are wider than the way
        walked = grid.away <= grid.away.min(initial=np.inf)
    nearest = [
        [viewpoints.apart_from(plan.pose(p, d)).min() for d in grid.directions_deg]
        for p in grid.positions
    ]
    losses = (1.0 - means) * np.exp(-np.array(nearest) / _LIKELY_APART)
    losses[~walked] = 0.0
    losses[chances >= _WEAK] = 0.0
    apart = max(_APART_CELLS * grid.side, _APART_OF_REACH * viewpoints.reach)
    spots: list[WeakSpot] = []
    while losses.max(initial=0.0) > 0.0 and len(spots) < _MOST:
        cell, direction = divmod(int(np.argmax(losses)), len(directions))
        why = _why(forecasts[cell][direction], plan, model, usual, within, unit)
        spots.append(WeakSpot(cell, direction, why))
        near = np.linalg.norm(level - level[cell], axis=1) <= apart
        losses[near[:, None] & (turns[direction] <= _APART_DEG)] = 0.0
    return spots


def _usually_in_view(model: CoverageModel, plan: Plan) -> float:
    """Places of the map that a mapping photo has in view, the median."""
    step = max(1, len(model.viewpoints) // _USUAL_PHOTOS)
    poses = [model.viewpoints.pose(image) for image in range(0, len(model.viewpoints), step)]
    counts = [len(model.forecast(pose, plan.camera).sight) for pose in poses]
    return float(np.median(counts)) / model.places.share


def _why(
    forecast: Forecast, plan: Plan, model: CoverageModel, usual: float, within: Within, unit: str
) -> str:
    """Say in words why the view is weak."""
    sight, outlook = forecast.sight, forecast.outlook
    in_view = round(len(sight) / model.places.share)
    if in_view == 0:
        return "nothing that the map knows is in view"
    reasons = []
    if in_view < _FEW_OF_USUAL * usual:
        share = in_view / usual
        reasons.append(
            f"in view is only {100 * share:.0f} % of what a mapping photo usually has in view"
        )
    # What would be found again if it were seen as the mapping photos saw it?
    expected = model.rematch.expected(sight).sum()
    level, octaves = np.zeros(len(sight)), float(np.median(sight.octaves))
    changes = {
        "half of what is in view was photographed only from "
        f"{np.median(sight.angles_deg):.0f}° aside or more": replace(sight, angles_deg=level),
        "what is in view lies behind what stands in front": replace(sight, behind=level),
    }
    if abs(octaves) > _OCTAVES:
        how = "nearer" if octaves > 0 else "further away"
        why = f"what is in view was photographed from {2.0 ** abs(octaves):.1f} times {how}"
        changes[why] = replace(sight, octaves=level)
    gains = {why: model.rematch.expected(seen).sum() / expected for why, seen in changes.items()}
    reasons += [why for why in sorted(gains, key=lambda why: -gains[why]) if gains[why] >= _GAIN]
    sides = np.array([plan.camera.width, plan.camera.height])
    if float((sight.pixels.std(axis=0) / sides).max()) < _SPREAD:
        reasons.append("all of it is in one part of the picture")
    if np.isfinite(outlook.scatter) and outlook.scatter > _OPEN * within.position:
        distance = float(np.median(sight.distances))
        reasons.append(f"half of it is further than {distance:.3g}{unit} away")
    if not reasons:
        reasons.append("what is in view is seldom found again")
    why = "; ".join(reasons[:_MOST_REASONS])
    return f"{why}: about {outlook.expected_inliers:.0f} matches expected"

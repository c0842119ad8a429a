"""When is a pose asked for other draws of its matches, and how much wider does it get?

    python -m benchmarks.redraws [--queries] [--data-dir ../shared/data] [--maps-dir DIR] [NAME ...]

Changes mapping photos and localizes each among the mapping photos next to it, without those taken
within 0.2 rad of it, as in a map's own test; or queries, in the whole map. Prints a table in
Markdown, by share of crowding and number of inliers: of how many poses the truth lies in the stated
ellipsoid of 95 %, before and after they are asked (docs/decisions/0049-matches-drawn-again.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
import typer
from scipy.stats import chi2

from benchmarks.change.kinds import changed
from benchmarks.speed.tables import table
from benchmarks.trust.asking import Maps
from benchmarks.trust.maps import SAMPLE, Places
from benchmarks.trust.outcomes import Query
from benchmarks.trust.scenarios import RIGHT, photos_of
from mapping.own_test.trials import left_out_with
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.localization.acceptance.corrections import crowding, widening, with_redraws
from visloc.localization.acceptance.gates import Problem, accepted
from visloc.localization.acceptance.judge import TIE_ANGLE, TIE_REACH_SHARE
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints
from visloc.options import LocalizeOptions
from visloc.pose.motion import moved_origin, position_covariance
from visloc.pose.reprojection import MatchedView
from visloc.priors import NO_PRIORS

MAPS = (SAMPLE, "castle", "redkitchen", "kitti_curve", "gardenspoint")
# None is unchanged; the others are kinds of ``benchmarks.change`` and their levels from 0.
CHANGES = (
    None,
    ("motion", 1),
    ("motion", 2),
    ("fog", 1),
    ("snow", 0),
    ("darkness", 1),
    ("compression", 2),
)
# Rows of the table: bounds of the number of inliers, and of crowding.
EDGE, MANY = 0.1, 300
ROWS = (
    *(((low, high), (0.0, EDGE)) for low, high in ((0, 100), (100, 200), (200, MANY))),
    *(((low, high), (0.0, EDGE)) for low, high in ((MANY, 500), (500, 10_000))),
    *(((0, MANY), bounds) for bounds in ((EDGE, 0.2), (0.2, 100.0))),
    *(((MANY, 10_000), bounds) for bounds in ((0.05, EDGE), (EDGE, 0.2), (0.2, 100.0))),
)
_SEARCHED = 20
_INSIDE = float(chi2.ppf(0.95, 3))


@dataclass(frozen=True, slots=True)
class Asked:
    """A pose that passed the gates, and what other draws of its matches say.

    Attributes:
        inliers: of it.
        crowding: of it.
        elsewhere: whether it is off by a tenth of the photos' reach, or by five degrees.
        distance2: from the truth, squared, in units of the stated covariance of the position.
        factor: by which that covariance grows.
        refused: whether it is refused then.
        seconds: of a processor.
    """

    inliers: int
    crowding: float
    elsewhere: bool
    distance2: float
    factor: float
    refused: bool
    seconds: float


def main(
    names: Annotated[list[str] | None, typer.Argument(help=f"Of {', '.join(MAPS)}.")] = None,
    queries: Annotated[bool, typer.Option("--queries", help="Ask queries.")] = False,
    most: Annotated[int, typer.Option(help="Photos of each map, for each change.")] = 20,
    data_dir: Annotated[Path, typer.Option(help="The shared data sets.")] = Path("../shared/data"),
    maps_dir: Annotated[Path, typer.Option(help="As of benchmarks.change.")] = Path(".trust/maps"),
) -> None:
    """Measure, and print one line for each range of inliers and of crowding."""
    places = Places(data_dir, maps_dir)
    maps = Maps(places.store, None)
    asked = []
    for name in names or MAPS:
        localizer = maps.localizer(name)
        for change in CHANGES:
            for query, options in _queries(places, localizer, name, queries, most):
                found = _ask(localizer, query, options, change)
                asked += [] if found is None else [found]
            typer.echo(f"{name}, {change or 'unchanged'}: {len(asked)} poses in all", err=True)
    heads = ["inliers", "crowding", "poses", "elsewhere", "elsewhere and not refused", "refused"]
    heads += ["inside, before", "inside", "factor of the deviation: median, 90 %", "s"]
    typer.echo("\n".join(table(heads, [_row(*bounds, asked) for bounds in ROWS])))


def _queries(
    places: Places, localizer: Localizer, name: str, queries: bool, most: int
) -> Iterator[tuple[Query, LocalizeOptions]]:
    """Yield photos and what they are asked with: queries, or mapping photos in others beside."""
    photos = list(photos_of(places, name, name, "query" if queries else "mapping", RIGHT))
    rows = {image.name: row for row, image in enumerate(localizer.map.images)}
    geometry = localizer.geometry
    for query in photos[:: -(-len(photos) // most)]:
        if queries:
            yield query, LocalizeOptions()
            continue
        row = rows[query.name]
        left_out = left_out_with(localizer.map, geometry.viewpoints, row)
        if left_out is not None:
            near = np.argsort(geometry.viewpoints.apart_from(geometry.viewpoints.pose(row)))
            near = near[~np.isin(near, left_out)][:_SEARCHED]
            yield query, LocalizeOptions(photos=tuple(map(geometry.photo_name, near)))


def _ask(
    localizer: Localizer, query: Query, options: LocalizeOptions, change: tuple[str, int] | None
) -> Asked | None:
    """Solve a photo up to the gates, and then draw again; None if it is refused by these."""
    geometry = localizer.geometry
    (only,), truth = query.photos, query.truth
    assert only.camera is not None
    assert truth is not None
    photo, camera = only.photo, only.camera
    if change is not None:
        photo, camera = changed(*change, query.name, photo, camera)
    look = localizer.look(photo, camera, options)
    view = MatchedView(look.camera, Pose.identity(), look.matches.pixels, look.matches.points)
    problem = Problem(
        (view,),
        (look.evidence.camera_source,),
        options,
        Constraints(geometry, NO_PRIORS),
        (look.shown,),
        (look.reduced,),
    )
    found = problem.solve() if len(view) >= problem.registration.min_inliers else None
    if found is None:
        return None
    found, refusal = accepted(problem, found)
    if refusal is not None or found.covariance is None:
        return None
    began = process_time()
    factor = widening(problem, found)
    seconds = process_time() - began
    pose, truth = found.rig_from_world, moved_origin(truth, -geometry.origin)
    away, degrees = pose_error(pose, truth)
    whole = geometry.errors.whole(pose, found.covariance, found.of_camera)
    error = pose.center - truth.center
    return Asked(
        found.num_inliers,
        crowding(problem, found),
        away > TIE_REACH_SHARE * geometry.reach or np.radians(degrees) > TIE_ANGLE,
        float(error @ np.linalg.solve(position_covariance(pose, whole), error)),
        factor,
        with_redraws(problem, found, geometry.reach)[1] is not None,
        seconds,
    )


def _row(
    inliers: tuple[int, int], crowded: tuple[float, float], asked: Sequence[Asked]
) -> list[str]:
    found = [
        each
        for each in asked
        if inliers[0] <= each.inliers < inliers[1] and crowded[0] <= each.crowding < crowded[1]
    ]
    cells = [f"{inliers[0]} to {inliers[1]}", f"{crowded[0]:g} to {crowded[1]:g}", str(len(found))]
    if not found:
        return [*cells, *["-"] * 7]
    elsewhere = [each for each in found if each.elsewhere]
    factors = np.quantile([np.sqrt(each.factor) for each in found], (0.5, 0.9))
    return [
        *cells,
        str(len(elsewhere)),
        str(sum(not each.refused for each in elsewhere)),
        str(sum(each.refused for each in found)),
        f"{np.mean([each.distance2 <= _INSIDE for each in found]):.0%}",
        f"{np.mean([each.distance2 / each.factor <= _INSIDE for each in found]):.0%}",
        f"{factors[0]:.2f}, {factors[1]:.1f}",
        f"{np.mean([each.seconds for each in found]):.2f}",
    ]


if __name__ == "__main__":
    typer.run(main)

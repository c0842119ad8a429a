"""When is a pose asked for other draws of its matches, and how much wider does it get?

    python -m benchmarks.redraws [--queries] [--data-dir ../shared/data] [--maps-dir DIR] [NAME ...]

Blurs mapping photos along a line and localizes each among the mapping photos next to it, without
those taken within 0.2 rad of it, as in a map's own test; or queries, in the whole map. Prints a table in Markdown: how often the
truth lies in the stated ellipsoid of 95 %, if no pose, the crowded ones or all are asked
(docs/decisions/0049-matches-drawn-again.md).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.stats import chi2

from benchmarks.change.kinds import KINDS
from benchmarks.trust.asking import Maps
from benchmarks.trust.maps import SAMPLE, Places
from benchmarks.trust.outcomes import Query
from benchmarks.trust.scenarios import RIGHT, photos_of
from mapping.own_test.trials import left_out_with
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.localization.acceptance.gates import Problem, accepted
from visloc.localization.acceptance.redraws import crowding, widening
from visloc.localization.geometry.constraints import Constraints
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.pose.centre import moved_origin, position_covariance
from visloc.pose.views import MatchedView
from visloc.priors import NO_PRIORS

MAPS = (SAMPLE, "castle", "redkitchen", "kitti_curve", "gardenspoint")
BLURS_PX = (0.0, 14.0, 28.0, 40.0)
SHARES = (0.05, 0.1, 0.2)
_MOST, _SEARCHED = 40, 20
_INSIDE = float(chi2.ppf(0.95, 3))


def main(
    names: Annotated[list[str] | None, typer.Argument(help=f"Of {', '.join(MAPS)}.")] = None,
    queries: Annotated[bool, typer.Option("--queries", help="Ask queries.")] = False,
    data_dir: Annotated[Path, typer.Option(help="The shared data sets.")] = Path("../shared/data"),
    maps_dir: Annotated[Path, typer.Option(help="As of benchmarks.change.")] = Path(".trust/maps"),
) -> None:
    """Measure, and print one line for each map and blur."""
    places = Places(data_dir, maps_dir)
    maps = Maps(places.store, None)
    typer.echo(
        "| map | blur, px | answers | inside, none asked | "
        + " | ".join(f"asked above {share:.0%}: inside" for share in SHARES)
        + " | all asked: inside | its factor of the deviation: median, 90 % |"
    )
    typer.echo(f"|---|---|---|---|{'---|' * len(SHARES)}---|---|")
    for name in names or MAPS:
        for blur in BLURS_PX:
            asked = _queries(places, maps.localizer(name), name, queries)
            rows = np.array(list(_answers(maps.localizer(name), asked, blur)))
            typer.echo(_line(name, blur, rows.reshape(-1, 3)))


def _queries(
    places: Places, localizer: Localizer, name: str, queries: bool
) -> Iterator[tuple[Query, LocalizeOptions]]:
    """Yield photos and what they are asked with: queries, or mapping photos in others beside."""
    photos = list(photos_of(places, name, name, "query" if queries else "mapping", RIGHT))
    chosen = photos[:: -(-len(photos) // _MOST)]
    if queries:
        yield from ((query, LocalizeOptions()) for query in chosen)
        return
    rows = {image.name: row for row, image in enumerate(localizer.map.images)}
    geometry = localizer.geometry
    for query in chosen:
        row = rows[query.name]
        left_out = left_out_with(localizer.map, geometry.viewpoints, row)
        if left_out is not None:
            near = np.argsort(geometry.viewpoints.apart_from(geometry.viewpoints.pose(row)))
            near = near[~np.isin(near, left_out)][:_SEARCHED]
            yield query, LocalizeOptions(photos=tuple(map(geometry.photo_name, near)))


def _answers(
    localizer: Localizer, asked: Iterable[tuple[Query, LocalizeOptions]], blur: float
) -> Iterator[tuple[float, float, float]]:
    """Yield of each right answer: crowding, factor, squared distance from the truth."""
    geometry = localizer.geometry
    for query, options in asked:
        (only,) = query.photos
        assert only.camera is not None
        assert query.truth is not None
        photo = only.photo
        if blur:
            rng = np.random.default_rng(zlib.crc32(query.name.encode()))
            photo, _ = KINDS["motion"].change(photo, only.camera, blur, rng)
        look = localizer.look(photo, only.camera, options)
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
            continue
        found, refusal = accepted(problem, found)
        if refusal is not None or found.covariance is None:
            continue
        pose, truth = found.rig_from_world, moved_origin(query.truth, -geometry.origin)
        metres, degrees = pose_error(pose, truth)
        if metres > RIGHT.max_position_error_m or degrees > RIGHT.max_orientation_error_deg:
            continue
        whole = geometry.errors.whole(pose, found.covariance, found.of_camera)
        error = pose.center - truth.center
        distance2 = float(error @ np.linalg.solve(position_covariance(pose, whole), error))
        yield crowding(problem, found), widening(problem, found), distance2


def _line(name: str, blur: float, rows: np.ndarray) -> str:
    if len(rows) == 0:
        return f"| {name} | {blur:g} | 0 |" + " - |" * (3 + len(SHARES))
    crowded, factor, distance2 = rows.T
    cells = [f"{np.mean(distance2 <= _INSIDE):.0%}"]
    for share in SHARES:
        asked = crowded > share
        inside = np.where(asked, distance2 / factor, distance2) <= _INSIDE
        cells.append(f"{asked.mean():.0%}: {inside.mean():.0%}")
    inside = np.mean(distance2 / factor <= _INSIDE)
    usual, largest = np.quantile(np.sqrt(factor), (0.5, 0.9))
    cells += [f"{inside:.0%}", f"{usual:.2f}, {largest:.2f}"]
    return f"| {name} | {blur:g} | {len(rows)} | {' | '.join(cells)} |"


if __name__ == "__main__":
    typer.run(main)

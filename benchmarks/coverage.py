"""The coverage model of ``mapping report``, held against queries at known poses.

    python -m benchmarks.coverage MAP QUERY --work DIR [--weights-dir DIR] [--plot FILE]
    python -m benchmarks.coverage --synthetic DIR [--plot FILE]

MAP is a folder of a map, id or id@version in --maps-dir; QUERY a kapture dataset with true poses.
The model is made of the map alone, as the report makes it. Then it says of each query, at its true
pose, how likely it is to be localized; and the query is localized. How well what was said ranks
what came is compared with what needs no model: how far the nearest mapping photo is.

--synthetic makes, in DIR, a map of a room of which one half was never photographed, and queries
all over it. Prints tables in Markdown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from scipy.stats import spearmanr

from mapping.cluster.workers import Workers
from mapping.own_test.held_out import Within, tolerance_of
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.work_folder import WorkFolder
from samples.render import render_depth, render_photo
from samples.scene import ROOM_SIZE_M, Scene, make_room
from visloc.archive import Map, MapStore
from visloc.evaluation import pose_error
from visloc.features import make_global_descriptor, make_local_features
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor, read_dataset, write_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import MapGeometry
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized
from visloc_extensions.report.held_out import hold_out
from visloc_extensions.report.model import CoverageModel, learn

_SYNTHETIC_FEATURES = "sift"
_NUM_MAPPING, _NUM_QUERIES = 40, 120
_CAMERA = Camera("PINHOLE", 480, 360, (340.0, 340.0, 240.0, 180.0))
_HEIGHT_M = 1.45
_NUM_WORST = 8


@dataclass(frozen=True, slots=True)
class Outcome:
    """A query: what was said of it, and what came.

    Attributes:
        name: of the photo.
        position_error: units of the world; infinity when refused.
        orientation_error_deg: degrees; infinity when refused.
        inliers: measured.
        expected_inliers: predicted at the true pose.
        position_std: predicted.
        probability: predicted.
        photo_away: distance to the nearest mapping photo.
        photo_turned_deg: angle to the mapping photo that looks most alike in direction, of those
            within the distance from which photos see.
        photo_apart: both together, ``Viewpoints.apart_from``.
    """

    name: str
    position_error: float
    orientation_error_deg: float
    inliers: int
    expected_inliers: float
    position_std: float
    probability: float
    photo_away: float
    photo_turned_deg: float
    photo_apart: float


def measure(localizer: Localizer, model: CoverageModel, queries: Dataset) -> Iterator[Outcome]:
    """Predict, then localize each photo of a dataset."""
    origin, viewpoints = localizer.geometry.origin, model.viewpoints
    for record in queries.images:
        camera, truth = queries.sensors[record.sensor_id].camera, queries.pose(record)
        if camera is None or truth is None:
            continue
        local = Pose(truth.rotation, truth.translation + truth.rotation @ origin)
        forecast = model.forecast(local, camera)
        photo = read_photo_file(queries.path_of(record))
        answer = localizer.localize(photo, camera, LocalizeOptions())
        errors = (math.inf, math.inf)
        if isinstance(answer, Localized):
            errors = pose_error(answer.cam_from_world, truth)
        away = np.linalg.norm(viewpoints.centers - local.center, axis=1)
        apart = viewpoints.apart_from(local)
        turned = np.degrees(apart - away / viewpoints.reach)
        turned[away > max(viewpoints.reach, away.min())] = np.inf
        yield Outcome(
            record.path,
            *errors,
            answer.evidence.num_inliers,
            forecast.outlook.expected_inliers,
            forecast.position_std,
            forecast.probability,
            float(away.min()),
            float(turned.min()),
            float(apart.min()),
        )


def make_half_mapped_room(folder: Path, seed: int = 0) -> tuple[Path, Path]:
    """Make a map of a room seen only from one half of it, looking only into that half.

    Returns:
        The folder of maps, which holds ``room``, and the dataset of queries: anywhere at eye level
        but within half a metre of walls, looking anywhere.
    """
    scene, random = make_room(seed), np.random.default_rng(seed)
    mapping = [_random_pose(random, half=True) for _ in range(_NUM_MAPPING)]
    queries = [_random_pose(random, half=False) for _ in range(_NUM_QUERIES)]
    _write_photos(folder / "mapping", scene, mapping, random, with_depth=True)
    _write_photos(folder / "query", scene, queries, random, with_depth=False)
    settings = BuildSettings(
        folder / "mapping", "room", folder / "maps", local_features=_SYNTHETIC_FEATURES, force=True
    )
    build_map(settings, lambda *_: None)
    return folder / "maps", folder / "query"


def _random_pose(random: np.random.Generator, *, half: bool) -> Pose:
    length, width, _ = ROOM_SIZE_M
    x = random.uniform(-length / 2 + 0.5, -0.3 if half else length / 2 - 0.5)
    y = random.uniform(-width / 2 + 0.5, width / 2 - 0.5)
    yaw = math.pi + random.uniform(-1.2, 1.2) if half else random.uniform(0, 2 * math.pi)
    pitch = random.uniform(-0.25, 0.1)
    forward = np.array(
        [math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)]
    )
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.array([x, y, _HEIGHT_M + random.uniform(-0.2, 0.2)]))


def _write_photos(
    root: Path,
    scene: Scene,
    poses: list[Pose],
    random: np.random.Generator,
    *,
    with_depth: bool,
) -> None:
    """Render photos, and depth maps, into a kapture dataset."""
    images, depth_maps = [], []
    for index, pose in enumerate(poses):
        image = FileRecord(index, "cam", f"{index:04d}.jpg")
        path = root / "sensors" / "records_data" / image.path
        path.parent.mkdir(parents=True, exist_ok=True)
        rgb = render_photo(scene, _CAMERA, pose, random)
        cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        images.append(image)
        if with_depth:
            depth_map = FileRecord(index, "depth", f"{index:04d}.depth")
            depth = render_depth(scene, _CAMERA, pose).astype("<f4")
            path.with_name(depth_map.path).write_bytes(depth.tobytes())
            depth_maps.append(depth_map)
    sensors = {"cam": Sensor.with_camera("cam", _CAMERA)}
    mounting = {"cam": Pose.identity()}
    if with_depth:
        sensors["depth"] = Sensor.with_camera("depth", _CAMERA, "depth")
        mounting["depth"] = Pose.identity()
    write_dataset(
        Dataset(
            root=root,
            sensors=sensors,
            rigs={"rig": mounting},
            trajectories={(index, "rig"): pose for index, pose in enumerate(poses)},
            images=tuple(images),
            depth_maps=tuple(depth_maps),
            gnss=(),
        )
    )


def print_table(outcomes: list[Outcome], within: Within) -> None:
    """Say how well each predictor ranks what came."""
    errors = np.array([o.position_error for o in outcomes])
    localized = np.isfinite(errors)
    good = (errors <= within.position) & (
        np.array([o.orientation_error_deg for o in outcomes]) <= within.orientation_deg
    )
    chances = np.array([o.probability for o in outcomes])
    typer.echo(
        f"\n{len(outcomes)} queries, {localized.sum()} localized, {good.sum()} within "
        f"{within.position:g} and {within.orientation_deg:g} degrees; predicted "
        f"{chances.sum():.1f}\n"
    )
    typer.echo("| predictor | all: rho | p | localized: rho | p | good or not: AUC |")
    typer.echo("|---|---|---|---|---|---|")
    predictors: dict[str, Callable[[Outcome], float]] = {
        "1 - probability": lambda o: -o.probability,
        "expected inliers, fewest first": lambda o: -o.expected_inliers,
        "position_std": lambda o: o.position_std,
        "distance to the nearest photo": lambda o: o.photo_away,
        "angle to a photo": lambda o: o.photo_turned_deg,
        "distance and angle to a photo": lambda o: o.photo_apart,
    }
    for name, predictor in predictors.items():
        values = np.array([predictor(outcome) for outcome in outcomes])
        cells = [*_rank(values, errors), *_rank(values[localized], errors[localized])]
        typer.echo(f"| {name} | {' | '.join(cells)} | {_auc(values, ~good)} |")
    inliers = np.array([o.inliers for o in outcomes])
    rho, p = _rank(np.array([o.expected_inliers for o in outcomes]), inliers.astype(np.float64))
    typer.echo(f"\nexpected and measured inliers: rho {rho}, p {p}\n")
    typer.echo("| worst queries | error | degrees | inliers | probability | its rank, 1 weakest |")
    typer.echo("|---|---|---|---|---|---|")
    ranks = np.argsort(np.argsort(chances, kind="stable"), kind="stable") + 1
    for row in np.argsort(-errors, kind="stable")[:_NUM_WORST]:
        o = outcomes[row]
        typer.echo(
            f"| {o.name} | {o.position_error:.3f} | {o.orientation_error_deg:.2f} | {o.inliers} "
            f"| {o.probability:.3f} | {ranks[row]} of {len(outcomes)} |"
        )
    typer.echo("\n| predicted | measured | queries |\n|---|---|---|")
    for rows in np.array_split(np.argsort(chances, kind="stable"), 5):
        typer.echo(f"| {chances[rows].mean():.2f} | {good[rows].mean():.2f} | {len(rows)} |")


def plot(outcomes: list[Outcome], path: Path) -> None:
    """Draw predicted against measured."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    errors = np.array([o.position_error for o in outcomes])
    chances = np.array([o.probability for o in outcomes])
    expected = np.array([o.expected_inliers for o in outcomes])
    found = np.array([o.inliers for o in outcomes])
    refused = ~np.isfinite(errors)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
    left.scatter(chances[~refused], errors[~refused], s=14, label="localized")
    top = 2 * errors[~refused].max(initial=0.01)
    left.scatter(chances[refused], np.full(refused.sum(), top), s=20, marker="x", label="refused")
    left.set(xlabel="predicted probability", ylabel="position error", yscale="log")
    left.legend()
    right.scatter(expected + 1, found + 1, s=14)
    right.set(xlabel="expected inliers + 1", ylabel="inliers + 1", xscale="log", yscale="log")
    figure.tight_layout()
    figure.savefig(path)


def _rank(values: NDArray[np.float64], errors: NDArray[np.float64]) -> tuple[str, str]:
    if len(values) < 3 or np.ptp(np.nan_to_num(values, posinf=1e9)) == 0:
        return "-", "-"
    found = spearmanr(values, errors)
    return f"{found.statistic:.2f}", f"{found.pvalue:.1g}"


def _auc(values: NDArray[np.float64], failed: NDArray[np.bool_]) -> str:
    """Chance that one that failed is ranked above one that did not."""
    if failed.all() or not failed.any():
        return "-"
    bad, good = values[failed][:, None], values[~failed]
    return f"{np.mean((bad > good) + 0.5 * (bad == good)):.2f}"


def learn_of(opened: Map, work: Path, workers: int) -> tuple[CoverageModel, Within]:
    """The model that the report of a map uses."""
    viewpoints = MapGeometry(opened).viewpoints
    within = tolerance_of(opened, viewpoints)
    with Workers(workers) as pool:
        runs = hold_out(opened, WorkFolder(work), pool, lambda *_: None)
    return learn(opened, viewpoints, runs, within, lambda *_: None).model, within


def main(
    map_ref: Annotated[str | None, typer.Argument(metavar="MAP")] = None,
    query: Annotated[Path | None, typer.Argument(help="kapture dataset with true poses.")] = None,
    maps_dir: Path = Path("maps"),
    weights_dir: Path | None = None,
    work: Annotated[Path, typer.Option(help="Keeps held-out runs.")] = Path("coverage-work"),
    synthetic: Annotated[Path | None, typer.Option(help="Make the half-mapped room here.")] = None,
    seed: int = 0,
    workers: int = 1,
    plot_to: Annotated[Path | None, typer.Option("--plot", help="Draw it into this file.")] = None,
) -> None:
    """Print how well the coverage model ranks the queries."""
    if synthetic is not None:
        maps_dir, query = make_half_mapped_room(synthetic, seed)
        map_ref, work = "room", synthetic / "work"
    if map_ref is None or query is None:
        raise typer.BadParameter("give MAP and QUERY, or --synthetic")
    opened = MapStore(maps_dir).open(map_ref)
    model, within = learn_of(opened, work, workers)
    name = opened.manifest.local_features.fingerprint.name
    localizer = Localizer(
        opened,
        make_local_features(name, weights_dir),
        partial(make_global_descriptor, weights_dir=weights_dir),
    )
    outcomes = list(measure(localizer, model, read_dataset(query)))
    print_table(outcomes, within)
    if plot_to is not None:
        plot(outcomes, plot_to)


if __name__ == "__main__":
    typer.run(main)

"""How many of the retrieved photos see what a query sees: retrieval measured by itself.

    python -m benchmarks.retrieval MAP QUERY_DATASET [--top-k 1,5,10,20,50]
        [--weights-dir DIR] [--min-shared N] [--global-features densevlad,localvlad]

MAP is the folder of a map, such as maps/ID, QUERY_DATASET a kapture dataset with true poses. A
photo of the map is co-visible with a query when at least N of the landmarks that it observes are
shared. A landmark is shared when, under the query's true pose,

- it projects into the query's image, from in front;
- the rays to it from both camera centres differ by at most 60 degrees, beyond which local features
  do not match (as in ``mapping.pairing.frustum``);
- neither centre is more than twice as far from it as the other: scale changes beyond are matched
  by luck;
- nothing is seen to hide it: fewer than 3 landmarks of the map that project into the same cell of
  the query (1/40 of its longer side) are nearer by more than a fifth. One or two may be outliers.
  Nothing else tells: where a map has no landmarks, as on a plain wall, it hides nothing.

Local features need not have been found there in the query: this is what could be matched.

Prints a table in Markdown: each global descriptor of the map alone, and all fused by every
operator; with ``--global-features`` as if the map had only those. Columns by k: the share of
co-visible photos among the best k, in percent, averaged over the queries; in brackets the same
divided by the best that was possible, min(k, co-visible photos) of k. Queries without a co-visible
photo are left out, and counted above the table.

Ready-made descriptors (``kapture:TYPE``) cannot be measured here: those of the queries are not
computed. ``localize compare --axis global-features --features-dir DIR`` sends them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from visloc.archive import Map, MapStore
from visloc.features import make_global_descriptor, make_local_features
from visloc.features.local.readymade import is_ready_made
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.query.feature_cache import FeatureCache
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.pose.reprojection import project
from visloc.retrieval.fusion import FUSION_OPERATORS, LateFusion
from visloc.retrieval.index import retrieve

MAX_ANGLE_DEG = 60.0
MAX_DISTANCE_RATIO = 2.0
CELLS_PER_SIDE = 40
NEARER_BY = 0.2
HIDING_LANDMARKS = 3


def visible_landmarks(
    points: NDArray[np.float64], camera: Camera, cam_from_world: Pose
) -> NDArray[np.bool_]:
    """Tell which points (P, 3) of the world a photo can show, as far as the points themselves tell.

    Returns:
        (P,) whether a point projects into the image and is not hidden behind others.
    """
    seen = cam_from_world.apply(points)
    pixels = project(camera, seen)
    depths = seen[:, 2]
    with np.errstate(invalid="ignore"):  # NaN, behind the camera, is not inside
        inside = (depths > 0) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(1)
    rows = np.flatnonzero(inside)
    cell_px = max(camera.width, camera.height) / CELLS_PER_SIDE
    column, line = (pixels[rows] / cell_px).astype(np.int64).T
    cells = line * (CELLS_PER_SIDE + 1) + column
    # In each cell the depth of its third landmark, counted from the camera.
    order = np.lexsort((depths[rows], cells))
    used, starts, counts = np.unique(cells[order], return_index=True, return_counts=True)
    front = np.full(int(cells.max(initial=0)) + 1, np.inf)
    hides = counts >= HIDING_LANDMARKS
    third = starts[hides] + HIDING_LANDMARKS - 1
    front[used[hides]] = depths[rows[order[third]]]
    visible = np.zeros(len(points), dtype=np.bool_)
    visible[rows] = front[cells] >= (1 - NEARER_BY) * depths[rows]
    return visible


def shared_landmarks(opened: Map, camera: Camera, cam_from_world: Pose) -> NDArray[np.int64]:
    """Count, for each photo (n,) of the map, its landmarks that a query with this pose shares."""
    origin = np.array(opened.manifest.world.origin)
    points = opened.landmarks.astype(np.float64) + origin
    visible = visible_landmarks(points, camera, cam_from_world)
    shared = np.zeros(len(opened.images), dtype=np.int64)
    for photo, row in enumerate(opened.image_poses):
        landmarks = np.unique(opened.observations(photo)[0])
        landmarks = landmarks[visible[landmarks]]
        rays = [
            points[landmarks] - center
            for center in (cam_from_world.center, Pose.from_quaternion(row[:4], row[4:]).center)
        ]
        near, far = np.sort([np.linalg.norm(r, axis=1) for r in rays], axis=0)
        cosines = (rays[0] * rays[1]).sum(axis=1) / np.maximum(near * far, 1e-12)
        shared[photo] = np.count_nonzero(
            (cosines >= np.cos(np.radians(MAX_ANGLE_DEG))) & (far <= MAX_DISTANCE_RATIO * near)
        )
    return shared


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """One photo of the dataset.

    Attributes:
        described: global descriptors by name.
        covisible: (n,) which photos of the map are co-visible with it.
    """

    described: Mapping[str, NDArray[np.float32]]
    covisible: NDArray[np.bool_]


def chosen(global_features: str | None, known: Sequence[str]) -> list[str]:
    """Return the global descriptors named with commas between, each once; None names all."""
    names = list(known) if global_features is None else global_features.split(",")
    for name in names:
        if is_ready_made(name):
            raise typer.BadParameter(
                f"{name} cannot be measured here, because a query's is not computed; name others",
                param_hint="--global-features",
            )
        if name not in known:
            raise typer.BadParameter(
                f"the map has no global descriptor {name!r}, only {', '.join(known)}",
                param_hint="--global-features",
            )
    return list(dict.fromkeys(names))


def whole_numbers(text: str) -> list[int]:
    """Parse positive whole numbers with commas between."""
    numbers = [int(k) if k.strip().isdecimal() else 0 for k in text.split(",")]
    if min(numbers) < 1:
        raise typer.BadParameter(f"not numbers from 1: {text!r}", param_hint="--top-k")
    return numbers


def queries(
    opened: Map, names: Sequence[str], root: Path, weights_dir: Path | None, min_shared: int
) -> Iterator[Query]:
    """Yield every photo of a kapture dataset that has a camera and a pose, described by these."""
    descriptors = {
        name: make_global_descriptor(name, weights_dir)
        for name in opened.global_descriptors
        if not is_ready_made(name)
    }
    extractor = make_local_features(opened.manifest.local_features.fingerprint.name, weights_dir)
    localizer = Localizer(opened, extractor, descriptors.__getitem__)
    options = LocalizeOptions(top_k=1, fusion_weights=dict.fromkeys(names, 1.0))
    dataset = read_dataset(root)
    for record in dataset.images:
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        if camera is None or pose is None:
            continue
        # The local features that a query has in service; some descriptors are made of them.
        found: FeatureCache = {}
        photo = read_photo_file(dataset.path_of(record))
        localizer.look(photo, camera, options, cache=found)
        (features,) = found.values()
        yield Query(
            {
                name: descriptors[name].describe(
                    features.rgb, features.local, opened.global_models[name]
                )
                for name in names
            },
            shared_landmarks(opened, camera, pose) >= min_shared,
        )


def recalls(
    asked: Sequence[Query], opened: Map, fusion: LateFusion, top_k: Sequence[int]
) -> list[tuple[float, float]]:
    """Return, for each k, the mean share of co-visible photos, and of the best possible."""
    ranked = [
        retrieve(query.described, opened.global_descriptors, len(opened.images), fusion=fusion)
        for query in asked
    ]
    means = []
    for k in top_k:
        most = min(k, len(opened.images))  # a small map has fewer photos
        shares, of_possible = [], []
        for query, found in zip(asked, ranked, strict=True):
            right = int(np.count_nonzero(query.covisible[found.images[:k]]))
            shares.append(right / most)
            of_possible.append(right / min(most, int(np.count_nonzero(query.covisible))))
        means.append((float(np.mean(shares)), float(np.mean(of_possible))))
    return means


def main(
    map_folder: Annotated[
        Path, typer.Argument(metavar="MAP", help="The folder of a map, such as maps/ID.")
    ],
    query_dataset: Annotated[Path, typer.Argument(help="kapture folder with true poses.")],
    top_k: str = "1,5,10,20,50",
    weights_dir: Path | None = None,
    min_shared: Annotated[int, typer.Option(min=1)] = 30,
    global_features: Annotated[
        str | None, typer.Option(help="Global descriptors, with commas; default: all.")
    ] = None,
) -> None:
    """Measure, print."""
    opened = MapStore(map_folder.parent).open(map_folder.name)
    names = chosen(global_features, list(opened.global_descriptors))
    numbers = whole_numbers(top_k)
    if is_ready_made(opened.manifest.local_features.fingerprint.name):
        raise typer.BadParameter(
            "its local features are ready-made, so photos cannot be looked at", param_hint="MAP"
        )
    every = list(queries(opened, names, query_dataset, weights_dir, min_shared))
    asked = [query for query in every if query.covisible.any()]
    if not asked:
        typer.echo(
            f"None of {len(every)} queries shares {min_shared} landmarks with a photo of "
            f"{opened.ref}: nothing to measure.",
            err=True,
        )
        raise typer.Exit(1)
    counts = [np.count_nonzero(query.covisible) for query in asked]
    typer.echo(
        f"{len(asked)} of {len(every)} queries share {min_shared} landmarks or more with a photo "
        f"of {opened.ref}: with {np.median(counts):g} of its {len(opened.images)} photos in the "
        f"median ({min(counts)} to {max(counts)})\n"
    )
    typer.echo(f"| retrieval by | {' | '.join(f'top {k}' for k in numbers)} |")
    typer.echo("|---" * (1 + len(numbers)) + "|")
    rows = {f"`{name}`": LateFusion(weights={name: 1.0}) for name in names}
    if len(names) > 1:
        equal = dict.fromkeys(names, 1.0)
        rows |= {f"all, `{operator}`": LateFusion(operator, equal) for operator in FUSION_OPERATORS}
    for label, fusion in rows.items():
        means = recalls(asked, opened, fusion, numbers)
        cells = " | ".join(f"{100 * share:.1f} ({100 * best:.1f})" for share, best in means)
        typer.echo(f"| {label} | {cells} |")


if __name__ == "__main__":
    typer.run(main)

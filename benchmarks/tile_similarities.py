"""How alike real photos are to the coarse index of a set: of one place, and of different places.

    python -m benchmarks.tile_similarities MAP=QUERY_DATASET ... --others FOLDER ...
        [--weights-dir DIR] [--out benchmarks/tile_similarities.json]

MAP is the folder of a map, such as maps/ID, QUERY_DATASET a kapture dataset with true poses in it.
The folders of others hold photos of as many different places as there are photos.

Vocabulary, whitening and planes are learned on every second of the others. What is compared has
taught nothing, as most photos of a large set have not. Photos of a map are described by what the
map stores, queries and others by their features, as a service with default options finds them.

Prints quantiles of cosine similarities; every dataset counts the same, whatever its size:

- nearest: of a query, the most similar photo of its own map;
- co-visible: photos of its map that share 30 landmarks with it (``benchmarks.retrieval``);
- apart: photos of its map that share none;
- elsewhere: a query and a photo of another map or one of the others; two of the others;
- own centroids: a query and the closest of the rows that stand for its map;
- other centroids: one of the others, or a query of another map, and the closest of those rows.

``benchmarks.tiles`` makes its photos by the file that is written.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.retrieval import shared_landmarks
from mapping.maps.coarse_model import learn_of_words
from visloc.archive import Map, MapStore
from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.features.descriptors.whitening import unit_rows
from visloc.kapture import read_dataset
from visloc.options import Extraction
from visloc.photos.reading import read_photo_file
from visloc.retrieval.inverted import MadeLists
from visloc.sets.coarse import (
    CoarseModel,
    described,
    descriptor_of,
    descriptors_of,
)

LEVELS = (0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999)
# What is compared, see above.
NAMES = ("nearest", "co-visible", "apart", "elsewhere", "own centroids", "other centroids")
# What a service with default options takes of a photo.
MAX_KEYPOINTS = 2500
MIN_SHARED = 30
# A photo of fewer is blank, and says nothing of places.
MIN_WORDS = 50

Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A map and its queries under the coarse descriptor.

    Attributes:
        photos: (n, D) of the map.
        centroids: (C, D) that stand for them.
        queries: (q, D).
        shared: (q, n) landmarks that both see.
    """

    photos: Rows
    centroids: Rows
    queries: Rows
    shared: NDArray[np.int64]

    @property
    def nearest(self) -> NDArray[np.int64]:
        """(q,) which photo is most similar to each query."""
        return np.asarray((self.queries @ self.photos.T).argmax(axis=1))


def words_of(path: Path, extractor: LocalFeatureExtractor) -> Rows:
    """Return the local descriptors (n, d) of a photo."""
    return extractor.extract(
        read_photo_file(path).rgb, max_keypoints=MAX_KEYPOINTS, extraction=Extraction.DEFAULT
    ).descriptors


def place_of(
    opened: Map, queries: Path, extractor: LocalFeatureExtractor, model: CoarseModel
) -> Place:
    """Describe a map, and the photos of a dataset that have a camera and a pose in it."""
    dataset = read_dataset(queries)
    rows, shared = [], []
    for record in dataset.images:
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        if camera is not None and pose is not None:
            rows.append(descriptor_of(words_of(dataset.path_of(record), extractor), model))
            shared.append(shared_landmarks(opened, camera, pose))
    photos = descriptors_of(opened, model)
    centroids = centroids_of(described(photos, model), model)
    return Place(photos, centroids, np.array(rows), np.array(shared))


def similarities(places: Sequence[Place], others: Rows) -> dict[str, list[Rows]]:
    """Return similarities by what was compared, a list of one array for each dataset."""
    found: dict[str, list[Rows]] = {name: [] for name in NAMES}
    for place in places:
        rest = [one for one in places if one is not place]
        own = place.queries @ place.photos.T
        found["nearest"].append(own.max(axis=1))
        found["co-visible"].append(own[place.shared >= MIN_SHARED])
        found["apart"].append(own[place.shared == 0])
        found["own centroids"].append((place.queries @ place.centroids.T).max(axis=1))
        away = np.concatenate([others, *(one.photos for one in rest)])
        found["elsewhere"].append((place.queries @ away.T).ravel())
        away = np.concatenate([others, *(one.queries for one in rest)])
        found["other centroids"].append((away @ place.centroids.T).max(axis=1))
    found["elsewhere"].append((others @ others.T)[np.triu_indices(len(others), 1)])
    return found


def quantiles(groups: Sequence[NDArray[np.float32]]) -> list[float]:
    """Return those of ``LEVELS``; groups that are not empty weigh the same."""
    groups = [group for group in groups if group.size]
    values = np.concatenate(groups)
    weights = np.concatenate([np.full(group.size, 1 / group.size) for group in groups])
    found = np.quantile(values, LEVELS, weights=weights, method="inverted_cdf")
    return [round(float(value), 4) for value in found]


def spectra(places: Sequence[Place], others: Rows) -> dict[str, list[float]]:
    """Say along which axes photos differ.

    Returns:
        Variances (D,) of sum 1: from place to place, within a place, and from a query to the photo
        nearest to it.
    """
    every = [np.concatenate([p.photos, p.queries]) for p in places]
    return {
        "places": shares([others]),
        "within": shares([rows - rows.mean(axis=0) for rows in every]),
        "nearest": shares([p.queries - p.photos[p.nearest] for p in places]),
    }


def shares(groups: Sequence[Rows]) -> list[float]:
    """Return the mean squares by axis, each group's of sum 1, averaged."""
    squares = np.array([np.square(rows, dtype=np.float64).mean(axis=0) for rows in groups])
    return [
        float(f"{share:.3g}") for share in (squares / squares.sum(1, keepdims=True)).mean(axis=0)
    ]


def table(rows: Sequence[tuple[str, Sequence[float]]]) -> str:
    """Return a table in Markdown of quantiles by name."""
    head = " | ".join(f"{100 * level:g} %" for level in LEVELS)
    lines = [f"| cosines | {head} |", "|---" * (1 + len(LEVELS)) + "|"]
    for name, values in rows:
        lines.append(f"| {name} | {' | '.join(f'{value:.2f}' for value in values)} |")
    return "\n".join(lines)


def centroids_of(tile: MadeLists, model: CoarseModel) -> Rows:
    """Return the unit centres of a tile's lists as descriptors."""
    return unit_rows(tile.centers) @ model["rotation"].T


def main(
    datasets: Annotated[list[str], typer.Argument(metavar="MAP=QUERIES")],
    others: Annotated[list[Path], typer.Option(help="Folders of photos of different places.")],
    weights_dir: Path | None = None,
    out: Path = Path("benchmarks/tile_similarities.json"),
) -> None:
    """Measure, print, write."""
    named = [(Path(one.split("=")[0]), Path(one.split("=")[1])) for one in datasets]
    maps = [MapStore(folder.parent).open(folder.name) for folder, _ in named]
    kind = maps[0].manifest.local_features.fingerprint.name
    extractor = make_local_features(kind, weights_dir)
    paths = [path for folder in others for path in sorted(folder.glob("*.jpg"))]
    words = [words for path in paths if len(words := words_of(path, extractor)) >= MIN_WORDS]
    teach, compare = words[::2], words[1::2]
    random = np.random.default_rng(0)
    model = learn_of_words(teach.__getitem__, len(teach), random)
    places = [
        place_of(opened, queries, extractor, model)
        for opened, (_, queries) in zip(maps, named, strict=True)
    ]
    rest = np.array([descriptor_of(one, model) for one in compare])
    found = {name: quantiles(groups) for name, groups in similarities(places, rest).items()}
    typer.echo(f"`{kind}`; learned on {len(teach)} photos, {rest.shape[1]} dimensions")
    typer.echo(
        f"{len(compare)} photos of different places; maps {', '.join(m.ref for m in maps)}\n"
    )
    typer.echo(table(list(found.items())))
    content = {"levels": LEVELS, "quantiles": found, "spectra": spectra(places, rest)}
    out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)

"""The pairs of a dataset's photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapping.methods.sfm_settings import SfmSettings
from mapping.pairing import Pairs, Scene, matched_pairs, pair_photos, read_pairs
from mapping.stages.photos import MappingPhoto
from visloc.archive import GlobalFeatures, Map
from visloc.errors import DatasetError, refuse
from visloc.kapture import Dataset, read_reconstruction
from visloc.kapture.matches import open_matches


def find_pairs(scene: Scene, settings: SfmSettings) -> Pairs:
    """Return the pairs of the pairs file, of the given matches, or else of the pairings."""
    if settings.pairs_file is not None:
        pairs = read_pairs(settings.pairs_file, scene)
    elif settings.matches_dir is not None:
        pairs = matched_pairs(open_matches(settings.matches_dir), scene)
    else:
        pairs = pair_photos(scene, settings.pairs, settings.pairing)
    if len(pairs) == 0:
        raise refuse(
            "pairs.none",
            field="--pairs" if settings.pairs_file is None else str(settings.pairs_file),
            got=f"{len(scene.names)} photos, no pair",
        )
    return pairs


def make_scene(
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    global_features: Sequence[GlobalFeatures],
    settings: SfmSettings,
) -> Scene:
    """Collect the inputs of pairings."""
    names = tuple(photo.name for photo in photos)
    wanted = "covisibility" in settings.pairs and settings.pairs_file is None
    return Scene(
        names=names,
        sensors=tuple(photo.record.sensor_id for photo in photos),
        timestamps=np.array([photo.record.timestamp for photo in photos], dtype=np.int64),
        cameras=tuple(photo.camera for photo in photos),
        cam_from_world=tuple(photo.cam_from_world for photo in photos),
        global_descriptors={f.fingerprint.name: f.descriptors for f in global_features},
        tracks=_tracks(dataset, names, settings.covisible_in)
        if wanted
        else np.empty((0, 2), dtype=np.int64),
    )


def _tracks(dataset: Dataset, names: Sequence[str], covisible_in: Map | None) -> NDArray[np.int64]:
    """Return (M, 2) rows: point, photo."""
    row_of_name = {name: row for row, name in enumerate(names)}
    if covisible_in is not None:
        counts = np.diff(covisible_in.observation_offsets)
        seen_in = [row_of_name.get(image.name, -1) for image in covisible_in.images]
        images = np.repeat(np.array(seen_in, dtype=np.int64), counts)
        points = np.asarray(covisible_in.observation_landmarks, dtype=np.int64)
    else:
        known = read_reconstruction(dataset.root)
        if known is None:
            raise refuse(
                "pairs.no_tracks",
                field=str(dataset.root / "reconstruction" / "observations.txt"),
                expected="points3d.txt and observations.txt there, or a map: --covisible-in MAP",
                kind=DatasetError,
            )
        seen_in = [row_of_name.get(name, -1) for name in known.images]
        images = np.array(seen_in, dtype=np.int64)[known.observations[:, 1]]
        points = known.observations[:, 0]
    return np.column_stack([points, images])[images >= 0]

"""Mapping photos, localized in a map that never had them.

What the map keeps of a photo is a query: its descriptors, its keypoints and its rows of the global
descriptors. The same functions as online answer it, from what would be in the map without the
photo and without those taken near it. Its landmarks that are gone then stay in the query: they
are what a photo of a place shows that the map does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.cluster.workers import Workers
from mapping.frames.stored_queries import match_stored, solve_stored
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc import __version__
from visloc.archive import Map, open_map
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.localization.acceptance.gates import registration_for
from visloc.localization.map_view.constraints import MapGeometry
from visloc.localization.map_view.viewpoints import Viewpoints
from visloc.matching.correspondences import Correspondences
from visloc.options import LocalizeOptions
from visloc.pose.reprojection import reprojection_errors
from visloc.pose.views import MatchedView
from visloc.retrieval.index import retrieve

_REVISION = 1
# Photos that are localized; of larger maps evenly many.
MAX_PHOTOS = 200
# How far from the photo others are left out, as ``Viewpoints.apart_from`` counts: nothing but the
# photo itself, then as if the mapper had walked by further away or not looked there.
LEAVE_OUT_WITHIN = (0.0, 0.2, 0.4, 0.6, 0.9)
_COUNTED_PART = 4


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """One run.

    Attributes:
        image: row of the map's photos.
        left_out: (k,) int64 rows of the photos that were left out, ``image`` among them.
        reason: of the refusal; "" when localized.
        position_error: units of the world; infinity when refused.
        orientation_error_deg: degrees; infinity when refused.
        inliers: of the best pose, believed or not.
        correct: (c,) int64 landmarks that were matched with where the photo does see them.
        errors_px: (c,) float64, how far from it their projections with the photo's pose are.
    """

    image: int
    left_out: NDArray[np.int64]
    reason: str
    position_error: float
    orientation_error_deg: float
    inliers: int
    correct: NDArray[np.int64]
    errors_px: NDArray[np.float64]

    @property
    def localized(self) -> bool:
        """Whether the map gave a pose."""
        return self.reason == ""


def hold_out(
    opened: Map,
    work: WorkFolder,
    workers: Workers,
    progress: Callable[[int, int], None],
) -> list[HeldOut]:
    """Localize mapping photos without themselves, and without ever more of their neighbours.

    Finished photos are found again in the work folder.

    Args:
        opened: the map.
        work: keeps finished photos.
        workers: where they are localized.
        progress: told how many photos are done, and of how many.

    Returns:
        By photo, then by how many were left out. Nothing for a map of which nothing would remain.
    """
    images = chosen_photos(len(opened.images))
    task = partial(_keep_runs, opened.path, work)
    items = ask_photos(work, workers, images, partial(_key, opened), task, progress)
    return [
        run for image, item in zip(images, items, strict=True) for run in _unpacked(image, item)
    ]


def ask_photos(
    work: WorkFolder,
    workers: Workers,
    images: Sequence[int],
    key: Callable[[int], str],
    task: Callable[[int], None],
    progress: Callable[[int, int], None],
) -> list[Item]:
    """Do a task for each photo that the work folder does not have yet.

    Args:
        work: where the task keeps its results.
        workers: where it is done; it travels there.
        images: rows of the photos.
        key: under which the result of a photo is kept.
        task: finds and keeps the result of one photo.
        progress: told how many photos are done, and of how many.

    Returns:
        The results, by photo.
    """
    todo = [image for image in images if not work.has(key(image))]
    done = len(images) - len(todo)
    progress(done, len(images))
    if todo:
        workers.run(task, todo, lambda now, _: progress(done + now, len(images)))
    return [work.read(key(image)) for image in images]


def chosen_photos(num_photos: int) -> list[int]:
    """Rows of at most ``MAX_PHOTOS`` photos, evenly spread."""
    return spread_photos(num_photos, MAX_PHOTOS)


def spread_photos(num_photos: int, most: int) -> list[int]:
    """Rows of at most so many photos, evenly spread."""
    chosen = np.linspace(0, num_photos - 1, min(num_photos, most)).astype(np.int64)
    return [int(image) for image in np.unique(chosen)]


def taken_with(opened: Map, image: int) -> NDArray[np.bool_]:
    """Which photos (n,) the same rig took at the same instant, the photo itself among them."""
    record = opened.images[image]
    on_rig = set[str]().union(*(rig for rig in opened.rigs.values() if record.camera in rig))
    others = on_rig - {record.camera}
    together = np.array(
        [i.timestamp == record.timestamp and i.camera in others for i in opened.images]
    )
    together[image] = True
    return together


def left_out_sets(opened: Map, viewpoints: Viewpoints, image: int) -> list[NDArray[np.int64]]:
    """Which photos (k,) to leave out in each run of one, fewest first.

    Those that the same rig took at the same instant always go with it: no query has them.
    """
    together = taken_with(opened, image)
    apart = viewpoints.apart_from(viewpoints.pose(image))
    sets: list[NDArray[np.int64]] = []
    for within in LEAVE_OUT_WITHIN:
        without = np.flatnonzero(together | (apart < within))
        is_new = not sets or len(without) > len(sets[-1])
        if is_new and len(without) < len(opened.images):
            sets.append(without)
    return sets


def localize_held_out(
    opened: Map, viewpoints: Viewpoints, image: int, left_out: NDArray[np.int64]
) -> HeldOut:
    """Localize one photo in what the map would be without some, itself among them."""
    options = LocalizeOptions()
    camera = opened.cameras[opened.images[image].camera]
    pose = viewpoints.pose(image)
    geometry = MapGeometry(opened)
    matched = match_held_out(geometry, image, left_out, options)
    pixels = opened.keypoints(image)[matched.keypoints].astype(np.float64)
    points = opened.landmarks[matched.landmarks].astype(np.float64)
    view = MatchedView(camera, Pose.identity(), pixels, points)
    errors_px = reprojection_errors(view, pose) if len(view) else np.empty(0)
    correct = errors_px <= registration_for(options, [camera]).max_error_px  # False for NaN

    solved = solve_stored(opened, image, geometry, matched, options)
    refusal, position_error, orientation_error = solved.answer.refusal, np.inf, np.inf
    if refusal is None and solved.pose is not None:
        position_error, orientation_error = pose_error(solved.pose.rig_from_world, pose)
    return HeldOut(
        image,
        left_out,
        "" if refusal is None else str(refusal.reason),
        position_error,
        orientation_error,
        sum(int(mask.sum()) for mask in solved.inliers),
        matched.landmarks[correct],
        errors_px[correct],
    )


def vanishing(opened: Map, left_out: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted landmarks that a map without some of its photos would not have.

    Those made of matches need two photos that see them, those of a depth map one.
    """
    seen = [opened.observations(int(image))[0] for image in left_out]
    return too_seldom_seen(opened, np.concatenate(seen))


def too_seldom_seen(opened: Map, seen: NDArray[np.integer]) -> NDArray[np.int64]:
    """``vanishing`` of the landmarks (k,) that the photos left out see, each as often."""
    least = 1 if opened.manifest.method.name == "rgbd" else 2
    num = len(opened.landmarks)
    if len(seen) > num // _COUNTED_PART:  # to sort so many takes longer than to count all
        counts = np.bincount(seen, minlength=num)
        landmarks = np.flatnonzero(counts)
        counts = counts[landmarks]
    else:
        landmarks, counts = np.unique(seen, return_counts=True)
    remaining = opened.track_lengths[landmarks].astype(np.int64) - counts
    return landmarks[remaining < least].astype(np.int64)


def match_held_out(
    geometry: MapGeometry,
    image: int,
    left_out: NDArray[np.int64],
    options: LocalizeOptions,
    features: NDArray[np.int64] | None = None,
) -> Correspondences:
    """Match a photo's features with a map without some of its photos, as the localizer does.

    Args:
        geometry: of the map; of one without landmarks, ``MapGeometry.without`` these photos.
        image: row of the photo.
        left_out: (k,) rows of the photos that the map is not to have.
        options: how many photos are asked.
        features: (m,) rows of the photo's features that count; None for all.
    """
    opened = geometry.opened
    remaining = np.ones(len(opened.images))
    remaining[left_out] = 0.0
    rows = opened.global_descriptors
    query = {name: rows[name][image] for name in opened.fusion.counted(rows)}
    retrieved = retrieve(query, rows, options.top_k, remaining, opened.fusion)
    gone = vanishing(opened, left_out) if opened.has_landmarks else None
    return match_stored(opened, image, geometry, retrieved.images.tolist(), gone, features)


def _key(opened: Map, image: int) -> str:
    return key_of(
        "held-out",
        _REVISION,
        program=__version__,
        options=repr(LocalizeOptions()),
        map=opened.manifest.content_hash,
        image=image,
        within=LEAVE_OUT_WITHIN,
    )


@lru_cache(maxsize=1)
def opened_once(folder: Path) -> tuple[Map, Viewpoints]:
    """A map, once per process: its arrays must not travel to workers with every photo."""
    opened = open_map(folder)
    return opened, MapGeometry(opened).viewpoints


def _keep_runs(folder: Path, work: WorkFolder, image: int) -> None:
    opened, viewpoints = opened_once(folder)
    work.get(_key(opened, image), lambda: _runs_of(opened, viewpoints, image))


def _runs_of(opened: Map, viewpoints: Viewpoints, image: int) -> Item:
    sets = left_out_sets(opened, viewpoints, image)
    return _packed([localize_held_out(opened, viewpoints, image, s) for s in sets])


def _packed(runs: Sequence[HeldOut]) -> Item:
    """The runs of one photo as arrays; lists of all runs lie one after another."""
    return {
        "reason": np.array([run.reason for run in runs], dtype=np.str_),
        "error": np.array(
            [(run.position_error, run.orientation_error_deg) for run in runs]
        ).reshape(-1, 2),
        "inliers": np.array([run.inliers for run in runs], dtype=np.int64),
        "num_left_out": np.array([len(run.left_out) for run in runs], dtype=np.int64),
        "num_correct": np.array([len(run.correct) for run in runs], dtype=np.int64),
        "left_out": np.concatenate([np.empty(0, np.int64), *(run.left_out for run in runs)]),
        "correct": np.concatenate([np.empty(0, np.int64), *(run.correct for run in runs)]),
        "errors_px": np.concatenate([np.empty(0), *(run.errors_px for run in runs)]),
    }


def _unpacked(image: int, item: Mapping[str, NDArray[np.generic]]) -> list[HeldOut]:
    left_out = _split(item["left_out"], item["num_left_out"])
    correct = _split(item["correct"], item["num_correct"])
    errors_px = _split(item["errors_px"], item["num_correct"])
    return [
        HeldOut(
            image,
            left_out[run].astype(np.int64),
            str(reason),
            float(item["error"][run, 0]),
            float(item["error"][run, 1]),
            int(item["inliers"][run]),
            correct[run].astype(np.int64),
            errors_px[run].astype(np.float64),
        )
        for run, reason in enumerate(item["reason"].tolist())
    ]


def _split(values: NDArray[np.generic], lengths: NDArray[np.generic]) -> list[NDArray[np.generic]]:
    return np.split(values, np.cumsum(lengths.astype(np.int64))[:-1]) if len(lengths) else []

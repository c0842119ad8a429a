"""Mapping photos, localized without themselves, and each result kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.cluster.workers import Workers
from mapping.own_test.held_out import (
    LEAVE_OUT_WITHIN,
    HeldOut,
    left_out_sets,
    localize_held_out,
    spread_photos,
)
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc import __version__
from visloc.archive import Map, open_map
from visloc.localization.map_view.constraints import MapGeometry, Viewpoints
from visloc.options import LocalizeOptions

_REVISION = 1
# Photos that are localized; of larger maps evenly many.
MAX_PHOTOS = 200


def hold_out(
    opened: Map,
    work: WorkFolder,
    workers: Workers,
    progress: Callable[[int, int], None],
) -> list[HeldOut]:
    """Localize mapping photos without themselves, and without ever more of their neighbours.

    Finished photos are found again in the work folder.

    Args:
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
        key: under which the result of a photo is kept.
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

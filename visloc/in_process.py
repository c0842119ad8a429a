"""A map that is asked in this process, without a server: for notebooks and scripts.

``visloc.open_map`` opens one. ``visloc.plot`` draws what comes of it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from visloc.accuracy import Compared, accuracy_of
from visloc.archive import Map, MapStore
from visloc.errors import VislocError, refuse
from visloc.evaluation import DEFAULT_THRESHOLDS, Threshold, pose_error
from visloc.features import make_global_descriptor, make_local_features
from visloc.features.local.readymade import is_ready_made
from visloc.features.networks.lightglue.load import make_lightglue
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.localization.places import solve_photo
from visloc.localization.solving import Look, SeenImage
from visloc.options import LocalizeOptions
from visloc.photos.formats import SUFFIXES
from visloc.photos.reading import Photo, read_photo_file
from visloc.priors import NO_PRIORS, Priors
from visloc.types import Answer, Localized, NotLocalized, Refusal

if TYPE_CHECKING:
    from pandas import DataFrame

_DEFAULTS = LocalizeOptions()


@dataclass(frozen=True, slots=True, eq=False)
class PhotoResult:
    """A photo that a map was asked about.

    Attributes:
        name: of the photo in its folder.
        path: of the photo's file.
        camera: the intrinsics that were given; None when they were unknown.
        options: those of the query.
        answer: the pose or the refusal; None when the photo could not be used.
        error: why it could not be used.
        truth: the true ``cam_from_world``, where the folder knows it. No query sees it.
    """

    map: LocalMap
    name: str
    path: Path
    camera: Camera | None
    options: LocalizeOptions
    priors: Priors
    answer: Answer | None
    error: VislocError | None = None
    truth: Pose | None = None

    @property
    def status(self) -> Literal["localized", "coarse", "not_localized", "error"]:
        """The outcome."""
        return "error" if self.answer is None else self.answer.status

    @property
    def pose(self) -> Pose | None:
        """``cam_from_world`` of a localized photo."""
        return self.answer.cam_from_world if isinstance(self.answer, Localized) else None

    @property
    def localized(self) -> bool:
        """Whether there is a pose; False with a coarse one only."""
        return self.pose is not None

    @property
    def refusal(self) -> Refusal | None:
        """Why there is no pose; None where there is one, or where ``error`` tells why."""
        answer = self.answer
        if not isinstance(answer, NotLocalized):
            return None
        return Refusal(answer.stage, answer.reason, answer.message, answer.candidates)

    @property
    def pose_error(self) -> tuple[float, float] | None:
        """Metres and degrees to the true pose; None when one of the two is missing."""
        pose, truth = self.pose, self.truth
        return None if pose is None or truth is None else pose_error(pose, truth)

    def row(self) -> dict[str, Any]:
        """The figures of this photo by the names of a table's columns; None where there is none.

        ``x``, ``y``, ``z`` are the camera's centre in the world and ``position_std`` is the root of
        the sum of its three variances, in the unit of the map (metres, if the map is metric).
        """
        center: Sequence[float | None] = (None, None, None)
        std = probability = None
        if isinstance(self.answer, Localized):
            center = self.answer.cam_from_world.center.tolist()
            std = float(np.linalg.norm(self.answer.position_std))
            probability = self.answer.probability
        evidence = None if self.answer is None else self.answer.evidence
        errors = self.pose_error or (None, None)
        return {
            "name": self.name,
            "status": self.status,
            "reason": self._reason(),
            **dict(zip("xyz", center, strict=True)),
            "position_std": std,
            "probability": probability,
            "inliers": None if evidence is None else evidence.num_inliers,
            "matches": None if evidence is None else evidence.num_correspondences,
            "seconds": None if evidence is None else sum(evidence.seconds.values()),
            "position_error": errors[0],
            "orientation_error_deg": errors[1],
        }

    def _reason(self) -> str | None:
        if self.error is not None:
            return self.error.code
        return None if self.refusal is None else self.refusal.reason.value

    def look_again(self) -> tuple[Photo, Look, NDArray[np.bool_]]:
        """Match the photo once more, for figures: a result keeps neither pixels nor matches.

        Returns:
            The decoded photo, its matches with the map, and for each match (n,) whether the best
            pose explains it.
        """
        if self.answer is None:
            assert self.error is not None  # one of both is there
            raise self.error
        photo, localizer = read_photo_file(self.path), self.map.localizer
        turned = self.answer.evidence.turned
        look = localizer.look(photo, self.camera, self.options, self.priors, turned=turned)
        image = SeenImage.alone(look)
        image, solved = solve_photo(image, localizer.geometry, self.options, self.priors)
        look = image.look or look
        none = np.zeros(len(look.matches.pixels), np.bool_)
        return photo, look, solved.inliers[0] if solved.inliers else none


class FolderResult(Sequence[PhotoResult]):
    """The photos of a folder that a map was asked about, in the order of the folder."""

    def __init__(self, photos: Sequence[PhotoResult]) -> None:
        self._photos = tuple(photos)

    def __len__(self) -> int:
        return len(self._photos)

    @overload
    def __getitem__(self, index: int) -> PhotoResult: ...

    @overload
    def __getitem__(self, index: slice) -> FolderResult: ...

    def __getitem__(self, index: int | slice) -> PhotoResult | FolderResult:
        if isinstance(index, slice):
            return FolderResult(self._photos[index])
        return self._photos[index]

    def __repr__(self) -> str:
        num_localized = sum(photo.status == "localized" for photo in self)
        return f"<{len(self)} photos, {num_localized} localized>"

    def rows(self) -> list[dict[str, Any]]:
        """Return the row of each photo, without pandas."""
        return [photo.row() for photo in self]

    def table(self) -> DataFrame:
        """Return a pandas table: a row for each photo (``PhotoResult.row``), by its name."""
        require("pandas")
        import pandas as pd

        return pd.DataFrame(self.rows()).set_index("name")

    def accuracy(self, thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS) -> dict[str, Any]:
        """Score the photos whose true poses are known, as ``localize evaluate`` does."""
        compared = [
            Compared(
                photo.truth,
                photo.pose,
                photo.answer.covariance if isinstance(photo.answer, Localized) else None,
            )
            for photo in self
            if photo.truth is not None
        ]
        if not compared:
            raise refuse("notebook.no_truth")
        return accuracy_of(compared, thresholds)


class LocalMap:
    """A map that is asked in this process. ``open_map`` makes one."""

    def __init__(self, localizer: Localizer) -> None:
        self.localizer = localizer

    @property
    def archive(self) -> Map:
        """The map's arrays, cameras and manifest."""
        return self.localizer.map

    def __repr__(self) -> str:
        counts = self.archive.manifest.counts
        return f"<{self.archive.ref}: {counts.images} photos, {counts.landmarks} landmarks>"

    def localize(
        self,
        photo: Path | str,
        camera: Camera | None = None,
        options: LocalizeOptions = _DEFAULTS,
        priors: Priors = NO_PRIORS,
    ) -> PhotoResult:
        """Find where a photo was taken.

        Args:
            camera: its intrinsics for the pixels as stored; None takes the focal length of EXIF, or
                estimates it.
            options: thresholds and the like.
            priors: what is known of the camera.
        """
        path = Path(photo)
        asked = PhotoResult(self, path.name, path, camera, options, priors, None)
        return self._answered(asked)

    def localize_folder(
        self,
        folder: Path | str,
        camera: Camera | None = None,
        options: LocalizeOptions = _DEFAULTS,
    ) -> FolderResult:
        """Find where each photo of a folder was taken, one on its own after the other.

        Args:
            folder: a kapture dataset, whose cameras count and whose poses become ``truth``; or a
                folder of photos, read with its subfolders.
            camera: the intrinsics of all photos of a folder that is no dataset, and of those of a
                dataset that does not know them.
            options: thresholds and the like.

        Returns:
            An answer for each photo; one that cannot be used has ``error``.
        """
        self.localizer.check(options)
        root = Path(folder)
        found = list(_photos_of(root))
        if not found:
            raise refuse("notebook.no_photos", field=str(root))
        results = []
        for name, path, own_camera, truth in found:
            used = own_camera or camera
            asked = PhotoResult(self, name, path, used, options, NO_PRIORS, None, None, truth)
            try:
                results.append(self._answered(asked))
            except VislocError as error:
                results.append(replace(asked, error=error))
        return FolderResult(results)

    def _answered(self, asked: PhotoResult) -> PhotoResult:
        photo = read_photo_file(asked.path)
        answer = self.localizer.localize(photo, asked.camera, asked.options, asked.priors)
        return replace(asked, answer=answer)


def open_map(
    ref: str, maps_dir: Path | str = "maps", weights_dir: Path | str | None = None
) -> LocalMap:
    """Open a map to ask it in this process, without a server.

    Args:
        ref: ``id`` or ``id@version``.
        maps_dir: the folder of maps, as for ``mapping build --maps-dir``.
        weights_dir: the folder of networks' weights; None for the weights that packages carry.

    Raises:
        NotFound: ``map.unknown``, ``map.version``.
        MapCorrupt: what opening it finds.
        Conflict: ``map.features`` when the map was built with other features than the installed
            ones.
        WeightsError: when weights are missing or damaged.
    """
    opened = MapStore(Path(maps_dir)).open(ref)
    weights = None if weights_dir is None else Path(weights_dir)
    name = opened.manifest.local_features.fingerprint.name
    return LocalMap(
        Localizer(
            opened,
            None if is_ready_made(name) else make_local_features(name, weights),
            partial(make_global_descriptor, weights_dir=weights),
            partial(make_lightglue, weights_dir=weights),
        )
    )


def require(package: str) -> None:
    """Refuse to go on without a package of the extra ``notebook``."""
    if importlib.util.find_spec(package) is None:
        raise refuse("notebook.packages", got=f"no {package}")


def _photos_of(root: Path) -> Iterator[tuple[str, Path, Camera | None, Pose | None]]:
    """Find name, path, camera and true pose of each photo."""
    if (root / "sensors" / "sensors.txt").is_file():
        dataset = read_dataset(root)
        for record in dataset.images:
            camera = dataset.sensors[record.sensor_id].camera
            yield record.path, dataset.path_of(record), camera, dataset.pose(record)
        return
    for path in sorted(root.rglob("*")):
        if path.suffix.lower() in SUFFIXES and path.is_file():
            yield path.relative_to(root).as_posix(), path, None, None

"""The job: from a new capture to a new version of the map, stage by stage."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.cluster.storage import map_folder, storage_failed, work_place
from mapping.cluster.workers import Workers
from mapping.maps.editing import content_of, joined
from mapping.methods.retrieval_only import no_landmarks
from mapping.methods.rgbd import (
    DepthSettings,
    landmarks_from_depth,
    lift_keypoints,
    refuse_without_depth,
)
from mapping.methods.sfm import landmarks_from_matches
from mapping.methods.sfm_settings import SfmSettings
from mapping.own_test.given_poses import readings_of
from mapping.own_test.publishing import publish_edited
from mapping.pipeline.pieces import without_pieces
from mapping.progress import Progress
from mapping.stages.colours import landmark_colours
from mapping.stages.context import BuildContext
from mapping.stages.landmarks import MadeLandmarks
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto, some
from mapping.stages.previews import keep_photos
from mapping.stages.publishing import photo_files, successor_of
from mapping.stages.work_folder import WorkFolder
from visloc.archive import Map, MapContent, MapStore, open_map
from visloc.archive.schema import photo_file
from visloc.evaluation import pose_error
from visloc.geometry import Similarity
from visloc.kapture import Dataset, read_dataset
from visloc_extensions.living_maps.updating.capture import (
    Capture,
    collect_capture,
    describe_capture,
    open_map_features,
    where_localized,
)
from visloc_extensions.living_maps.updating.joining import (
    landmarks_in_same_voxel,
    part_of_map,
    scaled_rigs,
)
from visloc_extensions.living_maps.updating.localizing import Placed, localize_photos
from visloc_extensions.living_maps.updating.placing import (
    Placement,
    beside,
    contradicted,
    evenly,
    place_capture,
    refuse_elsewhere,
)
from visloc_extensions.living_maps.updating.settings import (
    UpdateSettings,
    check_settings,
    method_for,
    refuse_few,
    refuse_strange_settings,
)

# Photos that are localized before the long work begins, to refuse a capture of another place.
_TRIED_FIRST = 8
# Photos that the tie is computed from, evenly spread.
_TIED_BY = 16


@dataclass(frozen=True, slots=True)
class UpdateRecord:
    """What the manifest keeps of an update, in ``updates`` of the method's settings.

    The figures from ``tried`` on are those of ``Placement``.

    Attributes:
        capture: its name, or the name of its folder.
        observations: added observations, of old and new landmarks.
        scale: units of the map per unit of the dataset.
    """

    capture: str
    poses: str
    method: str
    photos: int
    landmarks: int
    observations: int
    tried: int
    localized: int
    not_localized: dict[str, int]
    tied: int
    pixels: float
    position: float
    orientation_deg: float
    scale: float


@dataclass(frozen=True, slots=True)
class Updated:
    """The result of an update.

    Attributes:
        notes: on photos that were left out, one sentence each.
    """

    folder: Path
    record: UpdateRecord
    notes: tuple[str, ...]


def update_map(settings: UpdateSettings, progress: Progress) -> Updated:
    """Add a new capture to a map, as a new version.

    It becomes current unless its own test speaks against it.

    If it is killed, the same call finds its finished work again. The version that was current
    before stays current until the new one is complete and verified.
    """
    check_settings(settings)
    store = MapStore(settings.maps_dir)
    opened = open_map(map_folder(settings.map_ref, settings.maps_dir))
    map_id, version = opened.manifest.id, opened.manifest.version
    method = method_for(settings, opened)
    refuse_strange_settings(opened)
    dataset = read_dataset(settings.dataset).with_pixels_from(settings.pixel_origin)
    work = WorkFolder(work_place(settings.maps_dir, map_id))
    networks = Networks(settings.weights_dir, settings.inference)
    features = open_map_features(settings, opened, work, networks)
    try:
        with successor_of(opened, store):
            with Workers(settings.workers) as workers:
                context = BuildContext(work, features, networks, workers, progress)
                content, pictures, record, notes = _Job(
                    settings, opened, dataset, method, context
                ).run()
            folder = publish_edited(
                store,
                content,
                map_id,
                photos=pictures,
                based_on=version,
                accept=settings.accept,
                carried=opened.manifest.parts.doubts,
                progress=progress,
            )
            shutil.rmtree(work.root, ignore_errors=True)
    except OSError as error:
        raise storage_failed(error, work.root) from error
    return Updated(folder, record, notes)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """One update, with all that its steps need."""

    settings: UpdateSettings
    opened: Map
    dataset: Dataset
    method: str
    context: BuildContext

    def run(self) -> tuple[MapContent, list[Path], UpdateRecord, tuple[str, ...]]:
        """Return the updated map, its small photos if it keeps them, the record, and notes."""
        settings, by_depth = self.settings, self.method == "rgbd"
        capture, notes = collect_capture(
            self.context, settings, self.opened, self.dataset, with_depth=by_depth
        )
        count = len(capture.photos)
        if self.method == "sfm":
            refuse_few(count)
        rows = evenly(range(count), count if settings.poses == "localize" else _TIED_BY)
        # A capture of another place is refused before the long work begins.
        first = self._described(capture.take(evenly(rows, _TRIED_FIRST)))
        refuse_elsewhere(self.opened, self._localized(first))
        if by_depth:
            refuse_without_depth(self.dataset, capture.photos)
        capture = self._described(capture)
        tried = capture.take(rows)
        placed = self._localized(tried)
        placement = place_capture(
            self.opened,
            tried.photos,
            placed,
            settings.poses,
            self._lifted if by_depth else None,
            partial(readings_of, self.dataset, tried.photos),
            metric=settings.metric,
        )
        if settings.poses == "localize":
            capture, absent = where_localized(tried, placed)
            if absent:
                notes.append(f"{len(absent)} of {count} photos found no place: {some(absent)}")
        else:
            known = dict(zip(rows, placed, strict=True))
            capture, left_out = self._without_contradicted(
                capture, known, placement.map_from_dataset
            )
            notes += left_out
        return self._joined(capture, placement, notes)

    def _without_contradicted(
        self, capture: Capture, placed: dict[int, Placed], map_from_dataset: Similarity
    ) -> tuple[Capture, list[str]]:
        """Return the photos whose poses the map does not contradict, and notes on the others.

        Neighbours of a contradicted photo are tried as well, and left out if they are not
        localized.
        """
        count = len(capture.photos)

        def localized() -> list[int]:
            return [row for row, one in placed.items() if one.localized]

        wrong = contradicted(capture.photos, placed, map_from_dataset)
        if not wrong:
            return capture, []
        more = [row for row in beside(wrong, localized(), count) if row not in placed]
        placed = {**placed, **dict(zip(more, self._localized(capture.take(more)), strict=True))}
        wrong = contradicted(capture.photos, placed, map_from_dataset)
        doubtful = beside(wrong, localized(), count)
        off = [
            pose_error(map_from_dataset.move(capture.photos[row].pose), placed[row].cam_from_map)
            for row in wrong
        ]
        distance, angle = np.median(off, axis=0)
        unit = "m" if self.opened.manifest.world.metric else "units"
        notes = [
            f"{len(wrong)} of {count} photos left out, since the map localizes them {distance:.3g} "
            f"{unit}, {angle:.3g} degrees from their own poses, in the median: "
            f"{some([capture.names[row] for row in wrong])}"
        ]
        if doubtful:
            notes.append(
                f"{len(doubtful)} of {count} photos left out, since they are beside such, and not "
                f"localized: {some([capture.names[row] for row in doubtful])}"
            )
        gone = {*wrong, *doubtful}
        return capture.take([row for row in range(count) if row not in gone]), notes

    def _lifted(
        self, photo: MappingPhoto, pixels: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        keypoints, scale = pixels.astype(np.float32), self.settings.depth_scale
        lifted = lift_keypoints(self.dataset, photo, keypoints, scale)
        return lifted.rows, lifted.points

    def _described(self, capture: Capture) -> Capture:
        return describe_capture(self.context, self.settings, self.opened, self.dataset, capture)

    def _localized(self, capture: Capture) -> list[Placed]:
        return localize_photos(self.context, self.opened, capture.photos, capture.described)

    def _joined(
        self, capture: Capture, placement: Placement, notes: Sequence[str]
    ) -> tuple[MapContent, list[Path], UpdateRecord, tuple[str, ...]]:
        """Make landmarks of the photos, and join them to the map."""
        if self.method == "sfm":
            refuse_few(len(capture.photos))
        content = content_of(self.opened)
        map_from_dataset = placement.map_from_dataset
        if self.settings.poses == "localize" and not (self.settings.metric and content.metric):
            # Photos localized one by one do not tell the length of a rig in the map's unit.
            dataset = replace(self.dataset, rigs={})
        else:
            dataset = scaled_rigs(self.dataset, map_from_dataset.scale)
        made, same = self._landmarks(content, dataset, capture, map_from_dataset)
        placed = [capture.photos[row] for row in made.photos]
        if content.landmarks.colors is not None and made.landmarks.colors is None:
            colours = landmark_colours(self.context, placed, made.landmarks)
            made = replace(made, landmarks=replace(made.landmarks, colors=colours))
        part = part_of_map(content, dataset, capture, self.context.features, made, notes)
        # Equal notes on two captures are two notes.
        part = replace(part, notes=tuple(f"{self._name}: {note}" for note in part.notes))
        pictures = photo_files(self.opened)
        if pictures:
            folder = self.context.work.root / "small_photos"
            keep_photos(self.context, folder, placed)
            pictures += [folder / photo_file(row) for row in range(len(placed))]
        whole = joined(content, part, same)
        record = self._record(placement, content, whole)
        before = content.settings.get("updates", [])
        assert isinstance(before, list)
        settings = {**without_pieces(content.settings), "updates": [*before, asdict(record)]}
        return replace(whole, settings=settings), pictures, record, tuple(part.notes)

    @property
    def _name(self) -> str:
        return self.settings.capture or self.settings.dataset.resolve().name

    def _landmarks(
        self,
        content: MapContent,
        dataset: Dataset,
        capture: Capture,
        map_from_dataset: Similarity,
    ) -> tuple[MadeLandmarks, NDArray[np.int64] | None]:
        """Return landmarks of the new photos in the map's frame, and the map's rows for them."""
        if self.method != "rgbd":
            photos = [
                replace(photo, cam_from_world=map_from_dataset.move(photo.pose))
                for photo in capture.photos
            ]
            if not self.opened.has_landmarks:
                return no_landmarks(self.context, photos, metric=content.metric), None
            described = [
                replace(one, descriptors=capture.described[one.fingerprint.name])
                for one in content.global_features
            ]
            (made,) = landmarks_from_matches(
                self.context, dataset, photos, described, SfmSettings(), metric=content.metric
            )
            return made, None
        of_map = content.settings.get("voxel_size")  # only maps by depth have one
        made = landmarks_from_depth(
            self.context,
            self.dataset,
            capture.photos,
            DepthSettings(
                float(of_map) if isinstance(of_map, int | float) else None,
                self.settings.depth_scale,
            ),
            metric=content.metric,
            world_from_dataset=map_from_dataset,
        )
        centers = np.array([view.cam_from_world.center for view in made.views])
        corner = np.round(centers.mean(axis=0))  # like merging
        voxel_size = made.settings["voxel_size"]
        assert isinstance(voxel_size, float)
        return made, landmarks_in_same_voxel(content.landmarks, made.landmarks, corner, voxel_size)

    def _record(self, placement: Placement, before: MapContent, after: MapContent) -> UpdateRecord:
        settings, old, new = self.settings, before.landmarks, after.landmarks
        return UpdateRecord(
            capture=self._name,
            poses=settings.poses,
            method=self.method,
            photos=len(after.images) - len(before.images),
            landmarks=len(new.points) - len(old.points),
            observations=len(new.observed) - len(old.observed),
            tried=placement.tried,
            localized=placement.tried - sum(placement.not_localized.values()),
            not_localized=placement.not_localized,
            tied=placement.tied,
            pixels=placement.pixels,
            position=placement.position,
            orientation_deg=placement.orientation_deg,
            scale=placement.map_from_dataset.scale,
        )

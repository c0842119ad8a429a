"""``mapping build``: from a kapture dataset to a published map, stage by stage."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import JsonValue

from mapping.cluster.executors import LOCAL, Executor, open_executor
from mapping.cluster.stage_timings import Costs
from mapping.cluster.storage import (
    open_store,
    opened_dataset,
    scratch_folder,
    storage_errors,
    storage_failed,
    work_place,
)
from mapping.cluster.workers import one_thread_here
from mapping.methods.known_model import landmarks_from_reconstruction
from mapping.methods.retrieval_only import RETRIEVAL_ONLY, no_landmarks
from mapping.methods.rgbd import landmarks_from_depth
from mapping.methods.sfm import landmarks_from_matches
from mapping.own_test.given_poses import doubts_about_given
from mapping.own_test.publishing import Examine, write_content
from mapping.pairing import write_pairs
from mapping.pipeline.checks import check_settings, refuse_early
from mapping.pipeline.content import build_content
from mapping.pipeline.pieces import (
    WrittenMap,
    ids_of_pieces,
    note_of_largest,
    note_of_piece,
    publish_pieces,
    refuse_long_id,
)
from mapping.pipeline.settings import BuildSettings
from mapping.progress import Progress, one_step
from mapping.stages.colours import landmark_colours
from mapping.stages.context import BuildContext
from mapping.stages.global_features import describe_photos, read_global_features
from mapping.stages.landmarks import MadeLandmarks
from mapping.stages.local_features import (
    ExtractedFeatures,
    ReadyMadeFeatures,
    local_features_source,
)
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto, collect_photos, masked
from mapping.stages.previews import keep_photos
from mapping.stages.publishing import PAIRS
from mapping.stages.resolution import at_one_resolution
from mapping.stages.work_folder import WorkFolder, exclusive
from visloc.archive import GlobalFeatures, Map, MapStore
from visloc.archive.schema import PIECES, Doubt
from visloc.errors import VislocError, refuse
from visloc.features import check_local_features
from visloc.features.backends.choice import choose_inference
from visloc.features.local.readymade import is_ready_made
from visloc.kapture import Dataset
from visloc.options import Inference

Finish = Callable[[Sequence[MappingPhoto], MadeLandmarks], MadeLandmarks]
"""A last change of landmarks, given all photos of the dataset, before they become a map."""


def build_map(
    settings: BuildSettings,
    progress: Progress,
    costs: Costs | None = None,
    finish: Finish | None = None,
    examine: Examine | None = None,
) -> Path:
    """Build a map and publish it, as the current version unless its own test speaks against it.

    Photos without poses may fall apart into pieces. Each is published as a map of its own
    (``mapping.pipeline.pieces``).

    If it is killed, the same call finds its finished work again. The version that was current
    before stays current until the new one is complete and verified.

    Args:
        progress: is called with each stage and how much of it is done.
        costs: gathers the seconds and the memory of each stage.
        examine: returns doubts about the map beyond those of its own test.

    Returns:
        The folder of the new version, of the largest piece; for maps at a URL, of the local copy.
    """
    if settings.executor != LOCAL and settings.inference is Inference.AUTO:
        # Chosen for this machine; otherwise each machine of a cluster would choose for itself.
        settings = replace(settings, inference=choose_inference(settings.inference))
    check_settings(settings)
    if settings.sfm.estimate_poses:
        refuse_long_id(settings.map_id)
    store = open_store(settings.maps_dir, settings.cache_dir)
    refuse_existing_map(settings.map_id, store, force=settings.force)
    if not is_ready_made(settings.local_features):
        check_local_features(settings.local_features)
    scratch = scratch_folder(settings.maps_dir, settings.cache_dir, settings.map_id)
    work = WorkFolder(work_place(settings.work_dir or settings.maps_dir, settings.map_id))
    try:
        with (
            opened_dataset(settings.dataset) as dataset,
            open_executor(settings.executor, settings.workers, settings.ray_address) as workers,
            one_thread_here(),  # so that processors do not change the result
        ):
            if costs is not None:
                progress = costs.measured(progress, workers)
            # It opens the networks: missing weights are told before anything is written.
            context = _context(settings, work, workers, progress)
            with exclusive(scratch.with_name(f"{scratch.name}.lock")):
                if settings.work_dir is not None:
                    work.claim()
                dataset = dataset.with_pixels_from(settings.pixel_origin)
                folder = _Job(settings, dataset, store, scratch, context, finish, examine).run()
                work.remove()
                shutil.rmtree(scratch, ignore_errors=True)
    except storage_errors() as error:
        raise storage_failed(error, work.root) from error
    return folder


def refuse_existing_map(map_id: str, store: MapStore, *, force: bool) -> None:
    """Refuse to build a map that exists, unless a new version is wanted."""
    versions = store.versions(map_id)
    # A build that was killed while it published leaves versions of which none is current.
    if versions and map_id in store.ids() and not force:
        raise refuse(
            "map.exists",
            f"map {map_id!r} exists (version {versions[-1]}); --force publishes "
            "a new version and keeps the old one",
            field="--map",
        )


def _context(
    settings: BuildSettings, work: WorkFolder, workers: Executor, progress: Progress
) -> BuildContext:
    networks = Networks(settings.weights_dir, settings.inference)
    features = local_features_source(
        work,
        settings.dataset,
        settings.local_features,
        networks=networks,
        max_keypoints=settings.max_keypoints,
        features_dir=settings.features_dir,
        pixel_origin=settings.pixel_origin,
        workers=workers,
    )
    return BuildContext(work, features, networks, workers, progress)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """One build, with all that its steps need."""

    settings: BuildSettings
    dataset: Dataset
    store: MapStore
    scratch: Path
    context: BuildContext
    finish: Finish | None
    examine: Examine | None

    def run(self) -> Path:
        settings, context = self.settings, self.context
        photos, notes = self._collect()
        if settings.masks is not None:
            photos, more = masked(photos, settings.masks)
            notes = [*notes, *more]
        photos = at_one_resolution(photos, context.features)
        # Inputs that cannot give a map are refused before the long work begins.
        ready_made = {
            name: read_global_features(self.dataset, name, settings.features_dir, photos)
            for name in settings.global_features
            if is_ready_made(name)
        }
        with one_step(context.progress, "checks"):
            refuse_early(settings, self.dataset, photos)
        context.run("local features", context.features.prepare, photos)
        global_features = [
            ready_made[name] if name in ready_made else describe_photos(context, photos, name)
            for name in settings.global_features
        ]
        given = self._doubts_about_given(photos, global_features)
        try:
            pieces = self._landmarks(photos, global_features)
        except VislocError as error:  # wrong poses and depth make landmarks impossible, too
            for doubt in given:
                error.add_note(doubt.message)
            raise
        pieces = tuple(replace(made, doubts=(*given, *made.doubts)) for made in pieces)
        incoming = self.scratch / "incoming"
        shutil.rmtree(incoming, ignore_errors=True)  # of a build that was killed here
        try:
            written = self._written(incoming, photos, global_features, pieces, notes)
            with one_step(context.progress, "publication"):
                return publish_pieces(self.store, written, accept=settings.accept)
        finally:
            shutil.rmtree(incoming, ignore_errors=True)

    def _collect(self) -> tuple[list[MappingPhoto], list[str]]:
        settings, features = self.settings, self.context.features
        return collect_photos(
            self.dataset,
            posed=not settings.sfm.estimate_poses,
            with_files=isinstance(features, ExtractedFeatures)
            or settings.keep_photos
            or settings.keep_colours,
            has_features=features.has if isinstance(features, ReadyMadeFeatures) else None,
            with_depth=settings.method == "rgbd",
            depth_sensor=settings.depth_sensor,
            progress=partial(self.context.progress, "photos"),
        )

    def _doubts_about_given(
        self, photos: Sequence[MappingPhoto], global_features: Sequence[GlobalFeatures]
    ) -> tuple[Doubt, ...]:
        if self.settings.sfm.estimate_poses:
            return ()
        depth_scale = self.settings.depth.depth_scale if self.settings.method == "rgbd" else None
        return doubts_about_given(self.context, self.dataset, photos, global_features, depth_scale)

    def _landmarks(
        self, photos: Sequence[MappingPhoto], global_features: Sequence[GlobalFeatures]
    ) -> tuple[MadeLandmarks, ...]:
        settings, inputs = self.settings, (self.context, self.dataset, photos)
        metric = settings.poses_are_metric
        if settings.method == "rgbd":
            return (landmarks_from_depth(*inputs, settings.depth, metric=metric),)
        if settings.method == RETRIEVAL_ONLY:
            return (no_landmarks(self.context, photos, metric=metric),)
        if settings.method == "model":
            return (
                landmarks_from_reconstruction(
                    *inputs, settings.pixel_origin, settings.sfm, metric=metric
                ),
            )
        return landmarks_from_matches(*inputs, global_features, settings.sfm, metric=metric)

    def _written(
        self,
        incoming: Path,
        photos: Sequence[MappingPhoto],
        global_features: Sequence[GlobalFeatures],
        pieces: Sequence[MadeLandmarks],
        notes: Sequence[str],
    ) -> list[WrittenMap]:
        """Write and test the map of each piece, below a folder, the largest first."""
        ids = ids_of_pieces(self.store, self.settings.map_id, len(pieces))
        written: list[WrittenMap] = []
        # The largest last: it names the others.
        for made, map_id in reversed(list(zip(pieces, ids, strict=True))):
            if map_id != self.settings.map_id:
                made = replace(
                    made, notes=(*made.notes, note_of_piece(map_id, self.settings.map_id))
                )
            elif self.settings.sfm.estimate_poses:
                refs: list[JsonValue] = [each.ref for each in written]
                made = replace(
                    made,
                    notes=(*made.notes, *([note_of_largest(written)] if written else [])),
                    settings={**made.settings, PIECES: refs},
                )
            folder = incoming / map_id
            written.insert(0, self._write(folder, map_id, photos, global_features, made, notes))
        return written

    def _write(
        self,
        folder: Path,
        map_id: str,
        photos: Sequence[MappingPhoto],
        global_features: Sequence[GlobalFeatures],
        made: MadeLandmarks,
        notes: Sequence[str],
    ) -> WrittenMap:
        settings, context = self.settings, self.context
        if self.finish is not None:
            made = self.finish(photos, made)
        placed = [photos[row] for row in made.photos]
        if settings.keep_colours and made.landmarks.colors is None:
            colours = landmark_colours(context, placed, made.landmarks)
            made = replace(made, landmarks=replace(made.landmarks, colors=colours))
        content = build_content(
            settings,
            self.dataset,
            photos,
            context.features,
            global_features,
            made,
            (*self.dataset.notes, *notes),
        )
        there = set(made.photos.tolist())
        # Of a piece, that of the others says nothing: they make the largest map.
        is_largest = map_id == settings.map_id
        left_out = [p.name for row, p in enumerate(photos) if is_largest and row not in there]
        folder.mkdir(parents=True)
        if settings.keep_photos:
            keep_photos(context, folder, placed)
        if made.pairs is not None:
            write_pairs(folder / PAIRS, *made.pairs)
        if made.imported is not None:
            made.imported.write(folder)
        more_doubts = partial(self._more_doubts, made)
        version = write_content(
            folder,
            content,
            map_id,
            left_out,
            more_doubts,
            progress=context.progress,
            workers=context.workers,
        )
        return WrittenMap(folder, map_id, version, len(placed))

    def _more_doubts(self, made: MadeLandmarks, opened: Map) -> tuple[Doubt, ...]:
        """Return what speaks against a map beside its own test."""
        return (*made.doubts, *(self.examine(opened) if self.examine is not None else ()))

"""Incremental mapping, in steps that report progress.

The steps and their order are those of COLMAP's pipeline (Schönberger and Frahm, "Structure-from-
Motion Revisited", 2016). The pipeline itself reports nothing while it adjusts all photos, which
takes most of the time of large models. It also adjusts the finished model twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap

from mapping.methods.sparse.adjustment import adjust_growing
from mapping.methods.sparse.colmap_calls import interruptible, quiet
from mapping.progress import ItemProgress, part_of

# After so many photos in a row that do not join a small model, another pair begins a model.
_MIN_TRIALS = 30
# A first pair is looked for again with half as many inliers, half the angle, and both once more.
_RELAXATIONS = 4
# Each photo counts when it joins, when it was adjusted with all others so far, and at the end.
_COUNTS = 3
_Status = pycolmap.IncrementalPipelineStatus


def largest_model(
    path: Path, options: pycolmap.IncrementalPipelineOptions, progress: ItemProgress
) -> pycolmap.Reconstruction | None:
    """Return the largest model that incremental mapping finds; None without any.

    Models that do not connect are made one after another, while the photos left may be more than
    those of the largest.

    Args:
        options: with ``image_names``, the photos that take part.
        progress: called with how much of the current model is done, in photos: each is counted
            once when it joins, once when all photos so far were adjusted with it, and once when all
            are adjusted at the end.
    """
    if not options.image_names:  # pycolmap would take all photos
        return None
    with quiet(errors=False):  # that there is no model is not always an error
        with pycolmap.Database.open(path) as database:
            cache_options = pycolmap.DatabaseCacheOptions()
            cache_options.min_num_matches = options.min_num_matches
            cache_options.image_names = set(options.image_names)
            cache = pycolmap.DatabaseCache.create(database, cache_options)
        told = _Told(cache.num_images(), progress)
        model = interruptible(lambda token: _Job(cache, options, token, told).largest())
    progress(_COUNTS * told.photos, _COUNTS * told.photos)
    return model


@dataclass(slots=True)
class _Told:
    """Counts how much of the current model is done, and reports it."""

    photos: int
    progress: ItemProgress
    joined: int = 0
    adjusted: int = 0
    ended: int = 0

    def begin(self, joined: int) -> None:
        self.joined, self.adjusted, self.ended = joined, 0, 0
        self._tell(0)

    def join(self, joined: int) -> None:
        self.joined = joined
        self._tell(0)

    def adjust(self, share: float, *, at_end: bool) -> None:
        """Report a share of an adjustment of all photos that joined."""
        begun = self.ended if at_end else self.adjusted
        if share < 1:
            self._tell(int(share * (self.joined - begun)))
            return
        self.adjusted = self.joined
        self.ended = self.joined if at_end else self.ended
        self._tell(0)

    def _tell(self, more: int) -> None:
        done = self.joined + self.adjusted + self.ended + more
        # Never all: the model may not be the last.
        self.progress(min(done, _COUNTS * self.photos - 1), _COUNTS * self.photos)


class _Job:
    """Makes the models of a database."""

    def __init__(
        self,
        cache: pycolmap.DatabaseCache,
        options: pycolmap.IncrementalPipelineOptions,
        token: pycolmap.CancellationToken,
        told: _Told,
    ) -> None:
        self._cache, self._options, self._token, self._told = cache, options, token, told
        self._pipeline = pycolmap.IncrementalPipeline(
            options, cache, pycolmap.ReconstructionManager()
        )
        self._mapper = pycolmap.IncrementalMapper(cache)
        self._mapper_options = options.get_mapper()
        self._triangulation = options.get_triangulation()

    def largest(self) -> pycolmap.Reconstruction | None:
        for relaxation in range(1 + _RELAXATIONS):
            if relaxation:
                if relaxation % 2:
                    self._mapper_options.init_min_num_inliers //= 2
                else:
                    self._mapper_options.init_min_tri_angle /= 2
                self._mapper.reset_initialization_stats()
            models = self._models()
            if models:
                return max(models, key=_size)
        return None

    def _models(self) -> list[pycolmap.Reconstruction]:
        """Make models until none can be the largest any more."""
        options, photos = self._options, self._cache.num_images()
        least = min(int(0.8 * photos), options.min_model_size)
        models: list[pycolmap.Reconstruction] = []
        for _ in range(options.init_num_trials):
            model = pycolmap.Reconstruction()
            status = self._make(model)
            if self._token.is_cancelled:
                break
            if status == _Status.NO_INITIAL_PAIR:
                self._mapper.end_reconstruction(discard=True)
                break
            if status != _Status.SUCCESS:
                self._mapper.end_reconstruction(discard=True)
                continue
            count = model.num_reg_images()
            left = photos - self._mapper.num_total_reg_images()
            is_kept = count > 0 and (not models or count >= least)
            self._mapper.end_reconstruction(discard=not is_kept)
            if is_kept:
                models.append(model)
            most = max((_size(each)[0] for each in models), default=0)
            if left < max(most, 2) or len(models) >= options.max_num_models:
                break
        return models

    def _make(self, model: pycolmap.Reconstruction) -> pycolmap.IncrementalPipelineStatus:
        """Make a model of one pair, and of all photos that join it one after another."""
        mapper, options = self._mapper, self._options
        mapper.begin_reconstruction(model)
        status = self._pipeline.initialize_reconstruction(mapper, self._mapper_options, model)
        if status != _Status.SUCCESS:
            return status
        self._told.begin(model.num_reg_images())
        adjusted = model.num_reg_frames(), model.num_points3D()
        joins = joined_before = True
        while joins or joined_before:
            if self._token.is_cancelled:
                return _Status.INTERRUPTED
            joined_before, joins = joins, self._join_one(model)
            if joins:
                if self._pipeline.check_run_global_refinement(model, *adjusted):
                    self._refine(at_end=False)
                    adjusted = model.num_reg_frames(), model.num_points3D()
                self._told.join(model.num_reg_images())
            if mapper.num_shared_reg_images() >= options.max_model_overlap:
                break
            if not joins and joined_before:  # one more may join what is adjusted
                self._refine(at_end=True)
                adjusted = model.num_reg_frames(), model.num_points3D()
        if model.num_reg_frames() != adjusted[0]:
            self._refine(at_end=True)
        return _Status.SUCCESS

    def _join_one(self, model: pycolmap.Reconstruction) -> bool:
        """Let the first photo join that fits."""
        mapper, options = self._mapper, self._options
        for without_points in (False, True)[: 1 + options.structure_less_registration_fallback]:
            register = (
                mapper.register_next_structure_less_image
                if without_points
                else mapper.register_next_image
            )
            waiting = mapper.find_next_images(self._mapper_options, without_points)
            for trial, image_id in enumerate(waiting):
                if register(self._mapper_options, image_id):
                    self._grow(model, image_id)
                    return True
                if trial >= _MIN_TRIALS and model.num_reg_images() < options.min_model_size:
                    break
        return False

    def _grow(self, model: pycolmap.Reconstruction, image_id: int) -> None:
        """Triangulate what photos that joined together see, and adjust what is around them."""
        frame = model.image(image_id).frame
        assert frame is not None  # of every photo that joined
        for data_id in frame.image_ids:
            if model.image(data_id.id).num_points2D():
                self._mapper.triangulate_image(self._triangulation, data_id.id)
        self._mapper.iterative_local_refinement(
            self._options.ba_local_max_refinements,
            self._options.ba_local_max_refinement_change,
            self._mapper_options,
            self._options.get_local_bundle_adjustment(),
            self._triangulation,
            image_id,
        )

    def _refine(self, *, at_end: bool) -> None:
        """Adjust all photos, merge and filter points, and again while many of these change."""
        mapper, options, most = self._mapper, self._options, self._options.ba_global_max_refinements
        mapper.complete_and_merge_tracks(self._triangulation)
        mapper.retriangulate(self._triangulation)
        for number in range(most):
            observations = mapper.reconstruction.compute_num_observations()
            adjust_growing(
                mapper,
                options.get_global_bundle_adjustment(),
                options.constant_cameras,
                part_of(partial(self._tell_adjusted, at_end=at_end), number, most),
            )
            mapper.reconstruction.normalize()
            changed = mapper.complete_and_merge_tracks(self._triangulation)
            changed += mapper.filter_points(self._mapper_options)
            if changed < options.ba_global_max_refinement_change * observations:
                break
        mapper.clear_modified_points3D()
        mapper.filter_frames(self._mapper_options)
        self._told.adjust(1.0, at_end=at_end)

    def _tell_adjusted(self, done: int, steps: int, *, at_end: bool) -> None:
        if self._token.is_cancelled:
            raise InterruptedError  # ends this thread; the caller raises what interrupted it
        self._told.adjust(done / steps, at_end=at_end)


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()

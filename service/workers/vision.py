"""The work of a worker process: opening maps, looking at photos, solving for poses."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import perf_counter, time
from typing import Any

import numpy as np

from service.values import (
    Abandoned,
    ImageJob,
    InstantJob,
    Localization,
    MapFolder,
    MatchPicture,
    OpenMap,
    PackedLooks,
    PackedSequence,
    PackedSolved,
    Query,
    Rig,
    RigJob,
    SequenceJob,
    SequenceStep,
    Signals,
    WorkerSettings,
)
from service.workers.instants import (
    DecodedQuery,
    SolvedInMap,
    Target,
    Tools,
    check_images,
    check_options,
    check_priors,
    decode,
    refused_before,
    rig_in_map,
)
from service.workers.judging import gated, judged
from service.workers.open_maps import OpenMaps
from service.workers.sequences import SequenceRun
from service.workers.state import packed, unpacked
from visloc.drawing.matches_picture import draw_overlay
from visloc.errors import InvalidInput, VislocError
from visloc.localization.places import solve_photo
from visloc.localization.solving import Look, SeenImage, Solved, solve_instant
from visloc.localization.turning import is_worth_turning
from visloc.options import LocalizeOptions
from visloc.photos.reading import ImageLimits, Photo
from visloc.priors import Priors
from visloc.runtime.threads import summed, use_threads
from visloc.types import InstantAnswer

logger = logging.getLogger(__name__)


class Vision:
    """The maps that stay open in a worker process, and its tasks.

    The main process names the tasks by ``service.workers.tasks``; it pickles their arguments and
    what they return.
    """

    def __init__(self, settings: WorkerSettings, signals: Signals) -> None:
        self._settings = settings
        self._limits = ImageLimits(settings.max_image_bytes, settings.max_image_pixels)
        self._signals = signals
        self._maps = OpenMaps(settings, signals)

    @property
    def open_maps(self) -> tuple[OpenMap, ...]:
        return self._maps.refs

    use_threads = staticmethod(use_threads)

    def ping(self) -> int:
        """Return the id of the process, which shows that it is alive."""
        return os.getpid()

    def load(self, version: MapFolder) -> None:
        """Open a map, or a set without its tiles; errors as in ``OpenMaps.open``."""
        self._maps.open(version)

    def try_out(self, version: MapFolder) -> None:
        """Use a version once and close it again; errors as in ``OpenMaps.open``."""
        self._maps.try_out(version)

    def warm(self, version: MapFolder) -> None:
        """Open a map again that another process had open; log it if it cannot be used."""
        try:
            self._maps.open(version)
        except VislocError as error:
            logger.error("map %s is not loaded: %s", version.ref, error)  # noqa: TRY400

    def forget(self, ref: str) -> None:
        """Close a map that is no longer served."""
        self._maps.close(ref)

    def localize(self, job: RigJob, maps: Sequence[MapFolder], submitted: float) -> Localization:
        """Localize a photo on its own in the best of the maps.

        One task does it all in one process, so that no decoded photo passes between processes. The
        main process queued the task when it was ``submitted`` (``time.time``, which is the same in
        all processes).
        """
        started, queued = perf_counter(), time() - submitted
        targets = self._targets(maps, job.rig)
        check_options(targets, job.options)
        seconds = {"queued": max(0.0, queued), "open_map": perf_counter() - started}
        (image,) = job.images
        decoded = self._decode(image.query)
        seconds = summed(seconds, decoded.seconds)
        seen = [self._seen(job, target, decoded, seconds) for target in targets]
        looked, best, target, solved = self._solve_photo(job, targets, seen)
        began = perf_counter()
        turned = self._turned(job, targets, decoded, seen, best.answer)
        if turned is not None:
            again = self._solve_photo(job, targets, turned) if turned else None
            if again is not None and again[1].answer.pose is not None:
                looked, best, target, solved = again
            else:
                best = _with_seconds(best, {"turns": perf_counter() - began})
                if again is not None:  # its retrieved photos are still held as the photo is
                    coarse = again[1].answer.coarse
                    best = replace(best, answer=replace(best.answer, coarse=coarse))
        look = looked.look
        if not job.debug or look is None or not isinstance(decoded.query, Photo):
            return best
        self._step()
        told = gated(best, job.options)
        return replace(best, debug=_picture(decoded.query, target, look, told, solved))

    def _seen(
        self, job: RigJob, target: Target, decoded: DecodedQuery, seconds: Mapping[str, float]
    ) -> SeenImage:
        """Look at a photo on its own as it was sent, unless it was refused so before."""
        self._step()
        (image,) = job.images
        if job.refused is not None and isinstance(decoded.query, Photo):
            return refused_before(job, decoded.query, target.localizer.map_cameras, seconds)
        seen = target.look(image, decoded, job.options, job.priors, seconds)
        if seen.error is not None:
            raise seen.error
        return seen

    def _turned(
        self,
        job: RigJob,
        targets: Sequence[Target],
        decoded: DecodedQuery,
        seen: Sequence[SeenImage],
        answer: InstantAnswer,
    ) -> list[SeenImage] | None:
        """Look at a refused photo again, turned as each map seems to know it.

        Returns:
            What each map shows of it, empty when no turn promises more; None when other turns were
            not looked at.
        """
        photo, refusal = decoded.query, answer.refusal
        if refusal is None or not isinstance(photo, Photo):
            return None
        if not is_worth_turning(refusal.reason, job.options):
            return None
        (image,), again, any_turned = job.images, list[SeenImage](), False
        for target, one in zip(targets, seen, strict=True):
            began = perf_counter()
            turns, look = target.localizer.turns, one.look
            assert look is not None
            turned = 0
            if turns is not None:  # else other tiles took the photo, this one takes features only
                turned = turns.find(
                    photo,
                    look.evidence,
                    refusal.reason,
                    job.options,
                    job.priors,
                    decoded.found,
                    self._step,
                )
            seconds = summed(look.evidence.seconds, {"turns": perf_counter() - began})
            if turned:
                self._step()
                any_turned = True
                one = target.look(image, decoded, job.options, job.priors, seconds, turned)
            again.append(one)
        return again if any_turned else []

    def check_rig(self, job: RigJob, maps: Sequence[MapFolder]) -> None:
        """Refuse a rig's images, which come without their photos, or options that do not fit."""
        targets = self._targets(maps, job.rig)
        for target in targets:
            rig = None if job.rig is None else target.rig
            check_images(job.images, rig, self._settings.max_images, "images")
        check_options(targets, job.options)
        check_priors(targets, job.priors)

    def look_at_image(
        self,
        image: ImageJob,
        maps: Sequence[MapFolder],
        rig: Rig | None,
        options: LocalizeOptions,
        priors: Priors,
        submitted: float,
    ) -> PackedLooks:
        """Look at one image for every map; an image that cannot be used fails alone."""
        seconds = {"queued": max(0.0, time() - submitted)}
        self._step()
        targets = self._targets(maps, rig)
        decoded: DecodedQuery | InvalidInput
        try:
            decoded = self._decode(image.query)
            seconds = summed(seconds, decoded.seconds)
        except InvalidInput as error:
            decoded = error
        looks = [target.look(image, decoded, options, priors, seconds) for target in targets]
        return pickle.dumps(looks, pickle.HIGHEST_PROTOCOL)

    def solve_rig(
        self, job: RigJob, maps: Sequence[MapFolder], looks: Sequence[PackedLooks]
    ) -> Localization:
        """Estimate one pose of a rig, given without its photos, in the best of the maps."""
        targets = self._targets(maps, job.rig)
        return self._solve(job, targets, _by_map(looks, len(maps)))[1]

    def solve_instant(
        self, job: RigJob, version: MapFolder, looks: Sequence[PackedLooks], cameras: bytes
    ) -> tuple[Localization, PackedSolved]:
        """Solve an instant of a sequence in one of many maps, as ``solve_rig`` does.

        ``cameras``, pickled, is what earlier instants said of theirs.
        """
        self._step()
        (target,), (images,) = self._targets([version], job.rig), _by_map(looks, 1)
        geometry, options = target.localizer.geometry, job.options.before_rivals()
        solved = solve_instant(
            images, geometry, options, job.priors, job.timestamp, pickle.loads(cameras)
        )
        metric = target.localizer.map.manifest.world.metric
        told = pickle.dumps(SolvedInMap(solved, geometry.origin, metric), pickle.HIGHEST_PROTOCOL)
        return target.localization(solved.answer, ypr=job.ypr), told

    def _solve(
        self, job: RigJob, targets: Sequence[Target], seen: Sequence[tuple[SeenImage, ...]]
    ) -> tuple[int, Localization, Solved]:
        """Solve for a pose in every map; return the chosen answer and the row of its map.

        A raised ``min_probability`` does not count yet: the engine may compare the answer with
        those of other places.
        """
        solved, options = [], job.options.before_rivals()
        for target, images in zip(targets, seen, strict=True):
            self._step()
            solved.append(target.localizer.solve(images, options, job.priors, job.timestamp))
        return _judged(job, targets, solved)

    def _solve_photo(
        self, job: RigJob, targets: Sequence[Target], seen: Sequence[SeenImage]
    ) -> tuple[SeenImage, Localization, Target, Solved]:
        """Solve for the pose of a photo on its own in every map, as ``_solve``.

        Returns the photo as the chosen map saw it, the answer, and that map.
        """
        looked, solved, options = [], [], job.options.before_rivals()
        for target, image in zip(targets, seen, strict=True):
            self._step()
            geometry = target.localizer.geometry
            one = solve_photo(image, geometry, options, job.priors, job.timestamp)
            looked.append(one[0])
            solved.append(one[1])
        row, best, chosen = _judged(job, targets, solved)
        return looked[row], best, targets[row], chosen

    def in_set(self, map_set: MapFolder, task: str, *args: Any) -> Any:
        """Do a task of an open set: the method of this name, given the tools of this process."""
        began = time()
        opened = self._maps.opened_set(map_set)
        tools = Tools(self._settings, self._decode, self._step, began, time() - began)
        return getattr(opened, task)(tools, *args)

    def open_sequence(self, start: SequenceJob, maps: Sequence[MapFolder]) -> PackedSequence:
        settings = self._settings
        targets = self._targets(maps, start.rig)
        run = SequenceRun(start, targets, settings.max_images, settings.max_instants)
        return packed(run, self._kept(maps))

    def check_instants(
        self,
        sequence: PackedSequence,
        maps: Sequence[MapFolder],
        first: int,
        instants: Sequence[InstantJob],
    ) -> tuple[PackedSequence, list[Priors]]:
        """Refuse instants, without their photos, that cannot be solved; return their priors."""
        run = self._sequence(sequence, maps)
        priors = [run.check(first + i, instant) for i, instant in enumerate(instants)]
        return packed(run, self._kept(maps)), priors

    def add_instant(
        self,
        sequence: PackedSequence,
        maps: Sequence[MapFolder],
        instant: InstantJob,
        looks: Sequence[PackedLooks],
        priors: Priors,
    ) -> SequenceStep:
        """Solve the next instant of a sequence, given without its photos."""
        self._step()
        run = self._sequence(sequence, maps)
        found = run.add(instant, _by_map(looks, len(maps)), priors)
        answers = [run.localization(answer) for answer in found]
        kept = tuple(target.localizer.map.ref for target in run.targets)
        return SequenceStep(packed(run, self._kept(maps)), kept, answers)

    def finish_sequence(
        self, sequence: PackedSequence, maps: Sequence[MapFolder]
    ) -> list[Localization]:
        """Return the answers that are still waiting, when no more instants come."""
        run = self._sequence(sequence, maps)
        return [run.localization(answer) for answer in run.finish()]

    def _sequence(self, state: PackedSequence, maps: Sequence[MapFolder]) -> SequenceRun:
        run: SequenceRun = unpacked(state, self._kept(maps))
        return run

    def _kept(self, maps: Sequence[MapFolder]) -> dict[str, object]:
        """Return what this process has open of maps, by names that all processes share."""
        kept: dict[str, object] = {}
        for one in maps:
            localizer = self._maps.localizer(one)
            kept |= {f"localizer {one.ref}": localizer, f"geometry {one.ref}": localizer.geometry}
        return kept

    def _step(self) -> None:
        """Stop here when nobody waits any more."""
        if self._signals.abandoned:
            raise Abandoned

    def _decode(self, query: Query) -> DecodedQuery:
        decoded = decode(query, self._limits, self._maps.extractor)
        self._step()
        return decoded

    def _targets(self, maps: Sequence[MapFolder], rig: Rig | None) -> list[Target]:
        localizers = [self._maps.localizer(one) for one in maps]
        return [Target(found, rig_in_map(rig, found.map)) for found in localizers]


def _by_map(looks: Sequence[PackedLooks], num_maps: int) -> list[tuple[SeenImage, ...]]:
    """Return the looks of an instant's images by map; only ``look_at_image`` pickled them."""
    images: list[list[SeenImage]] = [pickle.loads(each) for each in looks]
    return [tuple(image[i] for image in images) for i in range(num_maps)]


def _with_seconds(found: Localization, more: Mapping[str, float]) -> Localization:
    answer = found.answer
    return replace(found, answer=replace(answer, seconds=summed(answer.seconds, more)))


def _picture(
    photo: Photo, target: Target, look: Look, found: Localization, solved: Solved
) -> MatchPicture:
    localizer, answer, matches = target.localizer, found.answer, look.matches
    outcome = answer.refusal or answer.pose
    assert outcome is not None  # an answer has one of both
    inliers = solved.inliers[0] if solved.inliers else np.zeros(len(matches.pixels), np.bool_)
    return MatchPicture(
        matches.pixels,
        matches.points + localizer.geometry.origin,
        inliers,
        draw_overlay(photo, localizer.map, look, outcome, inliers),
    )


def _judged(
    job: RigJob, targets: Sequence[Target], solved: Sequence[Solved]
) -> tuple[int, Localization, Solved]:
    """Choose among the answers of several maps; return the row of the map too."""
    found = [
        target.localization(one.answer, ypr=job.ypr)
        for target, one in zip(targets, solved, strict=True)
    ]
    row, best = judged(found, job.priors)
    return row, best, solved[row]

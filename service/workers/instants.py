"""The images of one instant, in worker processes: checked, and looked at in each map."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.values import (
    ONLY_SENSOR,
    ImageJob,
    Localization,
    PackedQuery,
    Query,
    Rig,
    RigJob,
    WorkerSettings,
)
from visloc.archive import Map
from visloc.archive.places import anchor_rms
from visloc.errors import InvalidInput, refuse
from visloc.features import LocalFeatureExtractor
from visloc.geometry import Pose
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints
from visloc.localization.query.camera import MapCamera, resolve_camera
from visloc.localization.query.feature_cache import FeatureCache
from visloc.localization.solving import Look, SeenImage, Solved
from visloc.options import LocalizeOptions
from visloc.photos.reading import ImageLimits, Photo, read_photo, with_mask
from visloc.priors import Priors
from visloc.runtime.threads import summed, timed
from visloc.types import (
    Evidence,
    InstantAnswer,
    MaskedImage,
    QueryFeatures,
    RigSensor,
)

_MAX_LISTED = 500  # characters of names from outside
# Errors of the request, not of one image, have codes that begin so.
_OF_ALL_IMAGES = ("features.required", "options.", "priors.")


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A map to search, and the rig's cameras as that map knows them."""

    localizer: Localizer
    rig: Mapping[str, RigSensor]

    def localization(self, answer: InstantAnswer, *, ypr: bool) -> Localization:
        """Return an answer with the map that gave it."""
        opened = self.localizer.map
        return Localization(
            answer,
            opened.manifest.id,
            opened.manifest.version,
            opened.geodetic,
            ypr,
            reach=self.localizer.geometry.reach,
            anchor_rms=anchor_rms(opened.manifest.world),
            metric=opened.manifest.world.metric,
        )

    def look(
        self,
        image: ImageJob,
        decoded: DecodedQuery | InvalidInput,
        options: LocalizeOptions,
        priors: Priors,
        seconds: Mapping[str, float],
        turned: int = 0,
    ) -> SeenImage:
        """Look at one image of an instant; an unusable image is returned with its error.

        Errors of the whole request are raised. ``seconds`` is the wall time, by stage, that the
        image took before; ``turned`` is what ``Localizer.turns`` found.
        """
        sensor = self.rig.get(image.sensor) or RigSensor(Pose.identity(), None)
        camera = image.camera or sensor.camera
        try:
            if isinstance(decoded, InvalidInput):
                raise decoded
            query = decoded.query
            if isinstance(query, QueryFeatures):
                look = self.localizer.look_at_features(query, camera, options, priors)
            else:
                look = self.localizer.look(
                    query, camera, options, priors, decoded.found, turned, alone=len(self.rig) == 1
                )
        except InvalidInput as error:
            if error.code.startswith(_OF_ALL_IMAGES):
                raise
            return SeenImage(image.sensor, sensor.cam_from_rig, None, error)
        evidence = replace(look.evidence, seconds=summed(seconds, look.evidence.seconds))
        return SeenImage(image.sensor, sensor.cam_from_rig, replace(look, evidence=evidence))


class SolvedInMap(NamedTuple):
    """What a map makes of an instant, in its own coordinates, which begin at ``origin``.

    Attributes:
        metric: whether the unit of the map is the metre.
    """

    solved: Solved
    origin: NDArray[np.float64]
    metric: bool


def refused_before(
    job: RigJob, photo: Photo, mapped: Sequence[MapCamera], seconds: Mapping[str, float]
) -> SeenImage:
    """Return a photo on its own that ``job.refused`` says enough about as it was sent."""
    assert job.refused is not None
    (image,), read_as = job.images, job.options.orientation
    used, source = resolve_camera(photo, image.camera, mapped)
    evidence = Evidence(used, source, photo.exif_orientation, read_as, seconds=seconds)
    return SeenImage.alone(Look.nothing(evidence, job.refused))


def rig_in_map(rig: Rig | None, opened: Map) -> Mapping[str, RigSensor]:
    """Return a rig's cameras by sensor id; for None, one camera at the identity."""
    if rig is None:
        return {ONLY_SENSOR: RigSensor(Pose.identity(), None)}
    if not isinstance(rig, str):
        return rig
    known = opened.rigs.get(rig)
    if known is None:
        raise refuse(
            "rig.unknown",
            field="rig",
            expected=f"one of {', '.join(opened.rigs)[:_MAX_LISTED]}"
            if opened.rigs
            else "a rig given inline",
            got=rig,
            ref=opened.ref,
        )
    return {
        sensor: RigSensor(cam_from_rig, opened.cameras.get(sensor))
        for sensor, cam_from_rig in known.items()
    }


def check_images(
    images: Sequence[ImageJob], rig: Collection[str] | None, max_images: int, where: str
) -> None:
    """Refuse images, of the field ``where``, that cannot be one instant of a rig.

    The rig is None when every instant is one image.
    """
    if len(images) > max_images:
        raise refuse(
            "rig.too_many_images", field=where, expected=f"at most {max_images}", got=len(images)
        )
    if rig is None and len(images) > 1:
        raise refuse("sequence.rig", field=where, got=f"{len(images)} images")
    for index, image in enumerate(images):
        if rig is not None and image.sensor not in rig:
            raise refuse(
                "rig.sensor",
                field=f"{where}[{index}].sensor",
                expected=f"one of {', '.join(rig)[:_MAX_LISTED]}",
                got=image.sensor,
            )
    twice = [sensor for sensor, n in Counter(image.sensor for image in images).items() if n > 1]
    if twice:
        raise refuse("rig.duplicate", field=where, got=f"{twice[0]} more than once")


def check_options(targets: Sequence[Target], options: LocalizeOptions) -> None:
    """Refuse options that do not fit all maps, before any image is decoded.

    The error is that of ``Localizer.check``. Among several maps, it names those that refuse the
    options, and says why the first of them does.
    """
    refused: dict[str, InvalidInput] = {}
    for target in targets:
        try:
            target.localizer.check(options, len(target.rig))
        except InvalidInput as error:
            refused[target.localizer.map.ref] = error
    if not refused:
        return
    ref, first = next(iter(refused.items()))
    if len(targets) == 1:
        raise first
    names = ", ".join(refused)[:_MAX_LISTED]
    raise refuse(
        first.code,
        f"the option does not fit all of the maps ({names}); in {ref}: {first.message}",
        field=first.field,
        expected=first.expected,
        got=first.got,
        kind=type(first),
    ) from first


def check_priors(targets: Sequence[Target], priors: Priors) -> None:
    """Refuse priors that a map cannot apply, before anything is computed."""
    for target in targets:
        Constraints(target.localizer.geometry, priors)


# Returns the extractor of local features with this name.
ExtractorOf = Callable[[str], LocalFeatureExtractor]


@dataclass(frozen=True, slots=True, eq=False)
class DecodedQuery:
    """A decoded photo, or the features that were sent instead of it.

    Attributes:
        found: features found in the photo so far.
        seconds: wall time by stage so far.
    """

    query: Photo | QueryFeatures
    found: FeatureCache
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Tools:
    """The parts of a worker process that tasks of extensions use.

    Attributes:
        decode: ``decode`` with the limits of the process.
        step: stops the task when nobody waits any more.
        began: ``time.time`` at which the task began.
        open_s: seconds that opening the set took.
    """

    settings: WorkerSettings
    decode: Callable[[Query], DecodedQuery]
    step: Callable[[], None]
    began: float
    open_s: float


def decode(query: Query, limits: ImageLimits, extractor_of: ExtractorOf) -> DecodedQuery:
    """Decode an encoded photo, or unpack what ``pack`` returned in this service."""
    if isinstance(query, PackedQuery):
        found, seconds = pickle.loads(query.found)
        found = {(extractor_of(name), *how): features for (name, *how), features in found.items()}
        again = decode(query.sent, limits, extractor_of)
        return DecodedQuery(again.query, found, summed(seconds, again.seconds))
    if isinstance(query, QueryFeatures):
        return DecodedQuery(query, {}, {})
    spent: dict[str, float] = {}
    with timed(spent, "decode"):
        if isinstance(query, MaskedImage):
            photo = with_mask(read_photo(query.image, limits), query.mask, limits)
        else:
            photo = read_photo(query, limits)
    return DecodedQuery(photo, {}, spent)


def pack(query: Query, decoded: DecodedQuery) -> PackedQuery:
    """Pack a query for other processes. Extractors, which each process has, go by name."""
    found = {
        (extractor.fingerprint.name, *how): features
        for (extractor, *how), features in decoded.found.items()
    }
    sent = query.sent if isinstance(query, PackedQuery) else query
    return PackedQuery(sent, pickle.dumps((found, decoded.seconds), pickle.HIGHEST_PROTOCOL))

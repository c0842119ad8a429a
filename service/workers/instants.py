"""The images of one instant: checked, looked at, solved. Runs in worker processes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.values import (
    ONLY_SENSOR,
    ImageJob,
    InstantLocalization,
    Query,
    Rig,
    RigSensor,
)
from service.workers.tiles import Read, summed
from visloc.archive import Map
from visloc.archive.places import anchor_rms
from visloc.errors import InvalidInput, refuse
from visloc.geometry import Pose
from visloc.images import Photo
from visloc.localization.constraints import Constraints
from visloc.localization.localizer import FeatureCache, Localizer
from visloc.localization.solving import Look, Matches, SeenImage
from visloc.priors import Priors
from visloc.types import InstantAnswer, LocalizeOptions, QueryFeatures, Reason, Refusal

_MAX_LISTED = 500  # characters of names from outside
# Codes that begin so say what is wrong with all images: that is wrong with the request.
_OF_ALL_IMAGES = ("features.required", "options.", "priors.")


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A map to search, and the rig as it is known there."""

    localizer: Localizer
    rig: Mapping[str, RigSensor]

    def localization(self, answer: InstantAnswer, *, ypr: bool) -> InstantLocalization:
        """Return an answer with the map that gave it."""
        opened = self.localizer.map
        return InstantLocalization(
            answer,
            opened.manifest.id,
            opened.manifest.version,
            opened.geodetic,
            ypr,
            reach=self.localizer.geometry.reach,
            anchor_rms=anchor_rms(opened.manifest.world),
        )


def rig_in_map(rig: Rig | None, opened: Map) -> Mapping[str, RigSensor]:
    """Return a rig's cameras; of None, one camera on its own.

    Raises:
        NotFound: ``rig.unknown`` when it is the id of a rig that the map does not know.
    """
    if rig is None:
        return {ONLY_SENSOR: RigSensor(Pose.identity(), None)}
    if not isinstance(rig, str):
        return rig
    known = opened.rigs.get(rig)
    if known is None:
        raise refuse(
            "rig.unknown",
            field="rig",
            expected=(
                f"one of {', '.join(opened.rigs)[:_MAX_LISTED]}"
                if opened.rigs
                else "a rig given inline"
            ),
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
    """Refuse images that are not those of one instant of a rig.

    Args:
        images: of one instant.
        rig: its cameras; None when every instant is one image.
        max_images: most images of an instant.
        where: the field that holds them, for errors.

    Raises:
        InvalidInput: ``rig.sensor``, ``rig.duplicate`` or ``sequence.rig``.
        TooLarge: ``rig.too_many_images``.
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
    """Refuse options that do not fit all maps, before any image is looked at.

    Raises:
        InvalidInput: as ``Localizer.check``; of several maps, with the names of those that the
            options do not fit, and what is wrong in the first of them.
        WeightsError: likewise.
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
    """Refuse priors that mean nothing in a map, before anything is computed.

    Raises:
        InvalidInput: ``priors.*``.
    """
    for target in targets:
        Constraints(target.localizer.geometry, priors)


def look_at(
    image: ImageJob,
    targets: Sequence[Target],
    options: LocalizeOptions,
    priors: Priors,
    read: Callable[[Query], Read],
    queued_s: float,
) -> list[SeenImage]:
    """Look at one image for every target. One that is unusable fails alone.

    Args:
        image: of an instant.
        targets: the maps.
        options: thresholds and the like.
        priors: what is known of the rig.
        read: reads a photo, or what was found in it.
        queued_s: how long it waited.

    Raises:
        VislocError: what concerns more than this image.
    """
    seconds = {"queued": queued_s}
    photo: Photo | QueryFeatures | InvalidInput
    found: FeatureCache = {}
    try:
        known = read(image.query)
        photo, found = known.query, known.found
        seconds = summed(seconds, known.seconds)
    except InvalidInput as error:
        photo = error
    return [_look(image, photo, target, options, priors, found, seconds) for target in targets]


def _look(
    image: ImageJob,
    photo: Photo | QueryFeatures | InvalidInput,
    target: Target,
    options: LocalizeOptions,
    priors: Priors,
    found: FeatureCache,
    seconds: Mapping[str, float],
) -> SeenImage:
    sensor = target.rig.get(image.sensor) or RigSensor(Pose.identity(), None)
    camera = image.camera or sensor.camera
    try:
        look: Look
        if isinstance(photo, InvalidInput):
            raise photo
        if isinstance(photo, QueryFeatures):
            look = target.localizer.look_at_features(photo, camera, options, priors)
        else:
            look = target.localizer.look(photo, camera, options, priors, found)
    except InvalidInput as error:
        if error.code.startswith(_OF_ALL_IMAGES):
            raise
        return SeenImage(image.sensor, sensor.cam_from_rig, None, error)
    if look.refusal is None and not _is_named(target, priors):
        look = _nothing_here(look)
    evidence = replace(look.evidence, seconds=summed(seconds, look.evidence.seconds))
    return SeenImage(image.sensor, sensor.cam_from_rig, replace(look, evidence=evidence))


def _is_named(target: Target, priors: Priors) -> bool:
    """Whether the device may be in a map, of a set whose tiles the priors name."""
    opened = target.localizer.map
    return priors.maps is None or not {opened.manifest.id, opened.ref}.isdisjoint(priors.maps)


def _nothing_here(look: Look) -> Look:
    """What an image shows of a tile that the priors exclude."""
    return Look(
        replace(look.evidence, num_correspondences=0, retrieved=()),
        Matches.none(),
        np.empty(0, np.int64),
        Matches.none(),
        Refusal(
            "retrieval", Reason.NO_PHOTO_NEAR, "the priors name other tiles, which do not show this"
        ),
    )

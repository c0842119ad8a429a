"""From requests in the words of the API to jobs of the engine."""

from __future__ import annotations

from collections.abc import Mapping

from service.values import (
    ONLY_SENSOR,
    ImageJob,
    InstantJob,
    Rig,
    RigJob,
    SequenceJob,
    Where,
    photo_job,
)
from visloc.errors import inside, refuse
from visloc.options import MAX_MAPS, Fallback, LocalizeOptions
from visloc.sequences.filling import DEFAULT_MAX_GAP_S, TimeUnit
from visloc_api.words.features import query_to_core
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.priors import priors_to_core
from visloc_api.words.rigs import LocalizeRigRequest, RigCalibration, RigImage
from visloc_api.words.sequences import Instant, LocalizeSequenceRequest, SequenceStart

NO_FILES: Mapping[str, bytes] = {}


class Parts:
    """The files of a form, each of which is one image or one mask."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._names = tuple(files)
        self._left = dict(files)

    def take(self, name: str, field: str) -> bytes:
        """Return the file that a field names."""
        if name not in self._left:
            raise refuse(
                "request.part",
                "another image or mask already uses this part"
                if name in self._names
                else "no file part of this name was sent",
                field=field,
                expected=f"one of the file parts: {', '.join(self._left) or 'none is left'}"[:500],
                got=name,
            )
        return self._left.pop(name)

    def check_all_taken(self) -> None:
        """Refuse a file that no image names."""
        if self._left:
            name = next(iter(self._left))
            raise refuse(
                "request.part",
                "no image of the request names this part",
                field=name[:100],
                expected='an image with "part": NAME, or "mask_part", for every file',
                got=name,
            )


def photo_job_of(request: LocalizeRequest) -> RigJob:
    """Return the work of localizing one photo."""
    if request.debug and request.features is not None:
        raise refuse("debug.needs_photo", field="debug", got="true")
    return photo_job(
        _where(request),
        query_to_core(request.image, request.features, request.mask),
        None if request.camera is None else request.camera.to_core(),
        request.options.to_core(),
        priors_to_core(request.priors),
        ypr=bool(request.ypr),
        debug=bool(request.debug),
    )


def rig_job_of(request: LocalizeRigRequest, files: Mapping[str, bytes] = NO_FILES) -> RigJob:
    """Return the work of localizing the images of a rig.

    Args:
        files: the files of a form by the names of their parts.
    """
    where = _where(request)
    if request.rig is None:
        raise refuse("request.missing_field", field="rig")
    rig, parts = _rig(request.rig), Parts(files)
    images, timestamp = _images(request.images, None, parts, has_rig=True)
    parts.check_all_taken()
    return RigJob(
        where,
        rig,
        images,
        timestamp,
        _options_without_fallback(request),
        priors_to_core(request.priors),
        ypr=bool(request.ypr),
    )


def sequence_job_of(start: SequenceStart) -> SequenceJob:
    """Return what the instants of a sequence share."""
    return SequenceJob(
        maps=_where(start),
        rig=None if start.rig is None else _rig(start.rig),
        time_unit=TimeUnit(start.time_unit) if start.time_unit else None,
        max_gap_s=DEFAULT_MAX_GAP_S if start.max_gap_s is None else start.max_gap_s,
        options=_options_without_fallback(start),
        priors=priors_to_core(start.priors),
        ypr=bool(start.ypr),
    )


def _options_without_fallback(request: LocalizeRigRequest | SequenceStart) -> LocalizeOptions:
    options = request.options.to_core()
    if options.fallback is not Fallback.NONE:
        raise refuse(
            "options.fallback",
            field="options.fallback",
            expected=f"{Fallback.NONE} for a rig or a sequence",
            got=options.fallback,
        )
    return options


def instant_job_of(instant: Instant, parts: Parts, *, has_rig: bool) -> InstantJob:
    """Return the work of one instant, its images not decoded."""
    images, _ = _images(instant.images, instant.timestamp, parts, has_rig=has_rig)
    return InstantJob(
        instant.timestamp,
        images,
        None if instant.odometry is None else instant.odometry.to_core(),
        None if instant.priors is None else instant.priors.to_core(),
    )


def sequence_jobs_of(
    request: LocalizeSequenceRequest, files: Mapping[str, bytes] = NO_FILES
) -> tuple[SequenceJob, list[InstantJob]]:
    """Return the work of a whole sequence.

    Args:
        files: the files of a form by the names of their parts.
    """
    sequence, parts, jobs = sequence_job_of(request), Parts(files), []
    for number, instant in enumerate(request.instants):
        with inside(f"instants[{number}]"):
            jobs.append(instant_job_of(instant, parts, has_rig=sequence.rig is not None))
    parts.check_all_taken()
    return sequence, jobs


def _where(request: LocalizeRequest | LocalizeRigRequest | SequenceStart) -> Where:
    """Return where to search: one of map, maps and near."""
    maps = request.maps
    given = [
        name
        for name, value in (("map", request.map), ("maps", maps or None), ("near", request.near))
        if value is not None
    ]
    if len(given) != 1 or maps == []:
        raise refuse("request.map", field="map", got=" and ".join(given) or "none of them")
    if request.near is not None:
        return request.near.to_core()
    if maps is None:
        assert request.map is not None
        return (request.map,)
    if len(maps) > MAX_MAPS or len(set(maps)) != len(maps):
        raise refuse(
            "request.map",
            "there are too many maps" if len(maps) > MAX_MAPS else "a map is named twice",
            field="maps",
            expected=f"at most {MAX_MAPS} different ones",
            got=len(maps) if len(maps) > MAX_MAPS else ", ".join(maps),
        )
    return tuple(maps)


def _rig(rig: str | RigCalibration) -> Rig:
    return rig if isinstance(rig, str) else rig.to_core()


def _images(
    images: list[RigImage], timestamp: int | None, parts: Parts, *, has_rig: bool
) -> tuple[tuple[ImageJob, ...], int | None]:
    """Return the images of an instant, and its timestamp where one is known."""
    jobs = []
    for number, image in enumerate(images):
        with inside(f"images[{number}]"):
            if image.timestamp is not None and timestamp not in (None, image.timestamp):
                raise refuse(
                    "rig.timestamps",
                    field="timestamp",
                    expected=f"{timestamp}, as of the others",
                    got=image.timestamp,
                )
            timestamp = timestamp if image.timestamp is None else image.timestamp
            jobs.append(_image(image, parts, has_rig=has_rig))
    return tuple(jobs), timestamp


def _image(image: RigImage, parts: Parts, *, has_rig: bool) -> ImageJob:
    if has_rig and not image.sensor:
        raise refuse("request.missing_field", field="sensor")
    content = image.image
    if image.part is not None:
        if content is not None or image.features is not None:
            raise refuse(
                "request.query",
                "an image must be given in exactly one way",
                field="image",
                expected="one of image, features, part",
                got="part and another",
            )
        content = parts.take(image.part, "part")
    mask = image.mask
    if image.mask_part is not None:
        if mask is not None:
            raise refuse(
                "request.query",
                "a mask must be given in exactly one way",
                field="mask",
                expected="one of mask, mask_part",
                got="both",
            )
        mask = parts.take(image.mask_part, "mask_part")
    return ImageJob(
        image.sensor or ONLY_SENSOR,
        query_to_core(content, image.features, mask),
        None if image.camera is None else image.camera.to_core(),
    )

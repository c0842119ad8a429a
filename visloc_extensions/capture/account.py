"""Tell what became of a capture, how good its map is, and what should be filmed again."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapping.maps.cameras import disputed_focal_lengths
from mapping.stages.photos import some
from visloc.archive import Map
from visloc_extensions.capture.frames import FilmedVideo
from visloc_extensions.capture.job import Captured
from visloc_extensions.capture.trying import LOST_SIZE, Trials

USED, NOT_CONNECTED, BLURRED = "used", "not connected", "too blurred"
STILL, SKIPPED = "camera did not move", "skipped: its neighbours show it"
_STILL = 0.02  # longer sides of the picture in a second
_GOOD, _USABLE = 0.9, 0.7
# With fewer of the photos in it, a map is poor; with fewer than the second share, it is not good.
_LEAST_IN_MAP, _MOST_IN_MAP = 0.5, 0.75
# Share by which photos and EXIF may differ about a focal length unsaid: makers round theirs.
_FOCAL_OFF = 0.05
# Names that a line lists.
_NAMED = 3
# Photos in a row that are not found, and show a weak spot of a good map.
_LEAST_RUN = 2
_PHOTO_OF_FILM = re.compile(r"(\d+\.\d+)s\.jpg")


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive seconds of a video, or photos of a folder, of one fate."""

    source: str
    what: str
    fate: str


def fates(
    captured: Captured, opened: Map, astray: Collection[str] = (), pieces: Sequence[Map] = ()
) -> list[Stretch]:
    """Return what became of each second of each video, and of each photo of each folder.

    Args:
        astray: names of frames that lie away from their film's others.
        pieces: maps of the photos that nothing links to those of the map.
    """
    fate_of = {i.name: f"used in {each.manifest.id}" for each in pieces for i in each.images}
    fate_of |= {image.name: USED for image in opened.images if image.name not in astray}
    stretches = []
    for source, video in captured.videos.items():
        stretches += _joined(source, _fates_of_seconds(source, video, fate_of))
    films = tuple(f"{source}/" for source in captured.videos)
    photos = [name for name in captured.photos if not name.startswith(films)]
    for source in dict.fromkeys(name.partition("/")[0] for name in photos):
        own = [name for name in photos if name.partition("/")[0] == source]
        for fate in (*dict.fromkeys([USED, *fate_of.values()]), NOT_CONNECTED):
            names = [name for name in own if fate_of.get(name, NOT_CONNECTED) == fate]
            if names:
                shown = ", ".join(name.partition("/")[2] for name in names[:_NAMED])
                more = ", ..." if len(names) > _NAMED else ""
                count = f"{len(names)} photo{'s' * (len(names) > 1)}"
                stretches.append(Stretch(source, f"{count}: {shown}{more}", fate))
    return stretches


def _fates_of_seconds(source: str, video: FilmedVideo, fate_of: Mapping[str, str]) -> list[str]:
    motion = video.motion
    photos = dict(zip(video.chosen.rows.tolist(), video.names, strict=True))
    found = []
    for second in range(int(motion.seconds[-1]) + 1):
        rows = np.flatnonzero((motion.seconds >= second) & (motion.seconds < second + 1))
        names = [photos[row] for row in rows.tolist() if row in photos]
        known = [fate_of.get(f"{source}/{name}", NOT_CONNECTED) for name in names]
        # Of the photos of a second, most tell: one that joined says nothing of the others.
        fate = max(known, key=lambda each: (known.count(each), each == USED), default=None)
        if fate is not None and fate != NOT_CONNECTED:
            found.append(fate)
        elif len(rows) and video.chosen.blurred[rows].all():
            found.append(BLURRED)
        elif names:
            found.append(NOT_CONNECTED)
        elif len(rows) == 0 or np.ptp(motion.path[rows]) < _STILL:
            found.append(STILL)
        else:
            found.append(SKIPPED)
    return found


def _joined(source: str, by_second: Sequence[str]) -> list[Stretch]:
    stretches, start = [], 0
    for end in range(1, len(by_second) + 1):
        if end == len(by_second) or by_second[end] != by_second[start]:
            stretches.append(Stretch(source, f"second {start} to {end}", by_second[start]))
            start = end
    return stretches


def verdict(trials: Trials, captured: Captured, opened: Map) -> str:
    """How good the map is, in a few sentences for everybody."""
    share = _share_found(trials)
    grade = "good" if share >= _GOOD else ("usable" if share >= _USABLE else "poor")
    doubts = opened.manifest.parts.doubts
    is_doubted = any(doubt.kind != LOST_SIZE for doubt in doubts)
    if is_doubted or len(opened.images) < _LEAST_IN_MAP * len(captured.photos):
        grade = "poor"
    elif grade == "good" and len(opened.images) < _MOST_IN_MAP * len(captured.photos):
        grade = "usable"
    size = (
        "Its unit is a metre."
        if opened.manifest.world.metric
        else "Its size is not known: give it with mapping edit --scale, or capture again with "
        "--marker-size or photos with GPS."
    )
    lines = [
        f"The map is {grade}: {len(opened.images)} of {len(captured.photos)} photos are in it.",
        *_missing(captured, opened),
        f"As a test, {_each_of(len(trials.right), len(opened.images))} was hidden from the map "
        f"together with its neighbours, and then looked for: {int(trials.right.sum())} of "
        f"{len(trials.right)} were found where the map has them. (This does not measure whether "
        "the map's shape is right.)",
        size,
        *_focal_lengths(opened),
        *(f"What speaks against it: {doubt.message}." for doubt in doubts),
    ]
    return " ".join(lines)


def _missing(captured: Captured, opened: Map) -> list[str]:
    there = {image.name for image in opened.images}
    names = [name for name in captured.photos if name not in there]
    return [f"Not in it: {some(names)}."] if names else []


def _each_of(tested: int, photos: int) -> str:
    return "each photo" if tested == photos else f"each of {tested} photos"


def _focal_lengths(opened: Map) -> list[str]:
    """Say what the own test cannot see: photos of one wrong focal length agree with each other."""
    return [
        f"Distances from the cameras to what they see may be {abs(found / used - 1):.0%} off: the "
        f"map uses a focal length of {used:.0f} px, but {found:.0f} px fit the photos best. They "
        "do not tell which is right."
        for used, found in disputed_focal_lengths(opened)
        if abs(found / used - 1) > _FOCAL_OFF
    ]


def film_again(trials: Trials, stretches: Sequence[Stretch], opened: Map) -> list[str]:
    """Return what to film again, and how.

    In a good map, most single photos that are not found are the ends of a walk: they tell nothing.
    """
    advice = {
        NOT_CONNECTED: "not linked to the rest for sure; begin and end where the map is good",
        BLURRED: "too blurred; walk slower, or with more light",
    }
    lines = [f"{s.source}, {s.what}: {advice[s.fate]}" for s in stretches if s.fate in advice]
    names = [opened.images[image].name for image in trials.images.tolist()]
    least = _LEAST_RUN if _share_found(trials) >= _GOOD else 1
    return lines + [
        f"{_span(run)}: photos there were not found; film it from more places, both ways"
        for run in _runs(names, trials.right.tolist())
        if len(run) >= least
    ]


def _share_found(trials: Trials) -> float:
    return float(trials.right.mean()) if len(trials.right) else 0.0


def _span(names: Sequence[str]) -> str:
    """Where photos in order begin and end: seconds of a film, else names."""
    source, _, first = names[0].partition("/")
    other, _, last = names[-1].partition("/")
    seconds = [_PHOTO_OF_FILM.fullmatch(name) for name in (first, last)]
    if source == other and all(seconds):
        begin, end = (f"{float(found[1]):.1f}" for found in seconds if found)
        return f"{source}, second {begin}" + (f" to {end}" if end != begin else "")
    return names[0] + (f" to {names[-1]}" if len(names) > 1 else "")


def _runs(names: Sequence[str], right: Sequence[bool]) -> Iterable[Sequence[str]]:
    """The names of runs of photos that did not come back."""
    start: int | None = None
    for place, holds in enumerate([*right, True]):
        if not holds and start is None:
            start = place
        elif holds and start is not None:
            yield names[start:place]
            start = None

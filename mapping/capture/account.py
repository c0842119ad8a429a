"""Tell what became of a capture, how good its map is, and what should be filmed again."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapping.capture.frames import FilmedVideo
from mapping.capture.job import Captured
from mapping.capture.trying import Trials
from visloc.archive import Map

USED, NOT_CONNECTED, BLURRED = "used", "not connected", "too blurred"
STILL, SKIPPED = "camera did not move", "skipped: its neighbours show it"
_STILL = 0.02  # longer sides of the picture in a second
_GOOD, _USABLE = 0.9, 0.7
# Names that a line lists.
_NAMED = 3


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
        captured: the capture.
        opened: its map.
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
                stretches.append(Stretch(source, f"{len(names)} photos: {shown}{more}", fate))
    return stretches


def _fates_of_seconds(source: str, video: FilmedVideo, fate_of: Mapping[str, str]) -> list[str]:
    motion = video.motion
    photos = dict(zip(video.chosen.rows.tolist(), video.names, strict=True))
    found = []
    for second in range(int(motion.seconds[-1]) + 1):
        rows = np.flatnonzero((motion.seconds >= second) & (motion.seconds < second + 1))
        names = [photos[row] for row in rows.tolist() if row in photos]
        known = [fate for name in names if (fate := fate_of.get(f"{source}/{name}"))]
        if known:
            found.append(USED if USED in known else known[0])
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
    """How good the map is, in a sentence or two for everybody."""
    share = float(trials.right.mean()) if len(trials.right) else 0.0
    grade = "good" if share >= _GOOD else ("usable" if share >= _USABLE else "poor")
    doubts = opened.manifest.parts.doubts
    if doubts or len(opened.images) < len(captured.photos) / 2:
        grade = "poor"
    size = (
        "its unit is a metre"
        if opened.manifest.world.metric
        else "its size is not known: give --scale or --marker-size, or photos with GPS"
    )
    return (
        f"the map is {grade}: {len(opened.images)} of {len(captured.photos)} photos are in it, and "
        f"{int(trials.right.sum())} of {len(trials.right)} photos that were tried came back where "
        f"they were taken, without themselves and those beside them; {size}"
        + "".join(f"; {doubt.message}" for doubt in doubts)
    )


def film_again(trials: Trials, stretches: Sequence[Stretch], opened: Map) -> list[str]:
    """Return what to film again, and how."""
    advice = {
        NOT_CONNECTED: "was not connected to the rest: film it again, beginning and ending where "
        "the map is good",
        BLURRED: "was too blurred: film it again, slower or with more light",
    }
    lines = [f"{s.source}, {s.what}: {advice[s.fate]}" for s in stretches if s.fate in advice]
    names = [opened.images[image].name for image in trials.images.tolist()]
    return lines + [
        f"around {first if first == last else f'{first} to {last}'}: photos there do not "
        "come back; film it again from more places, both ways"
        for first, last in _runs(names, trials.right.tolist())
    ]


def _runs(names: Sequence[str], right: Sequence[bool]) -> Iterable[tuple[str, str]]:
    """First and last names of runs of photos that did not come back."""
    start: int | None = None
    for place, holds in enumerate([*right, True]):
        if not holds and start is None:
            start = place
        elif holds and start is not None:
            yield names[start], names[place - 1]
            start = None

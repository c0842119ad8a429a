"""Draws the matches between a query and a map.

The query with its matches is on the left, the most similar photos of the map on the right; lines
join the two keypoints of a match.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.archive.schema import MAX_PHOTO_BYTES, MAX_PHOTO_SIDE
from visloc.errors import InvalidInput, refuse
from visloc.localization.solving import Look
from visloc.options import ReadAs
from visloc.photos.reading import (
    ImageLimits,
    Photo,
    read_photo,
    turn_of,
    upright,
    upright_from_stored,
)
from visloc.types import Answer, NotLocalized, Refusal, RigPose

Canvas = NDArray[np.uint8]
# A pose with its uncertainty, or why there is none.
Outcome = Answer | RigPose | Refusal
Color = tuple[int, int, int]

_WIDTH = 1600
_MARGIN = 16
_QUERY_BOX = (900, 1000)  # width, height
_GAP = 12
_HEAD_PX, _CAPTION_PX, _FOOT_PX = 106, 46, 36
_COLUMNS = 2
_CELL_WIDTH = (_WIDTH - 3 * _MARGIN - _QUERY_BOX[0] - (_COLUMNS - 1) * _GAP) // _COLUMNS
_CELL_HEIGHT = round(_CELL_WIDTH * 3 / 4)
_MAX_ROWS = 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_TEXT = 250  # characters of a line
_SHIFT = 4  # fractional bits of coordinates for OpenCV
_MAX_LINES = 30  # per photo of the map; more cannot be told apart
_JPEG_QUALITY = 88
# Photos of a map are small (docs/map-format.md) unless it was tampered with.
_PREVIEW_LIMITS = ImageLimits(max_bytes=MAX_PHOTO_BYTES, max_pixels=MAX_PHOTO_SIDE**2)

_GROUND: Color = (22, 24, 28)
_EMPTY: Color = (36, 39, 45)
_TEXT: Color = (232, 232, 232)
_DIM: Color = (160, 164, 170)
_INLIER: Color = (40, 220, 90)
_OUTLIER: Color = (255, 70, 60)
_SEEN: Color = (120, 170, 255)
# Line colours of the map's photos, distinct also for red-green colour blindness.
_LINES: tuple[Color, ...] = (
    *((255, 200, 0), (0, 200, 255), (255, 110, 220), (240, 240, 240)),
    *((255, 140, 40), (170, 150, 255), (0, 230, 180), (200, 160, 110)),
)


@dataclass(frozen=True, slots=True)
class _Panel:
    """The place of a photo on the canvas. ``scale`` is canvas pixels per photo pixel."""

    left: int
    top: int
    width: int
    height: int
    scale: tuple[float, float]

    @property
    def rows(self) -> slice:
        return slice(self.top, self.top + self.height)

    @property
    def columns(self) -> slice:
        return slice(self.left, self.left + self.width)

    def place(self, keypoints: NDArray[np.floating]) -> NDArray[np.float64]:
        """Move keypoints (n, 2) to the canvas, where a pixel's centre is a whole number."""
        corner = np.array([self.left, self.top])
        return np.asarray(keypoints * np.array(self.scale) + corner - 0.5, dtype=np.float64)

    def contains(self, keypoints: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which keypoints (n, 2) lie in the photo."""
        moved = keypoints * np.array(self.scale)
        inside = (moved >= 0) & (moved <= [self.width, self.height])
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """A photo of the map on the canvas, with its keypoints.

    Attributes:
        left: where its caption begins.
        panel: in pixels of its camera.
        preview: (H, W, 3) RGB; None if the map keeps no photos.
        keypoints: (m, 2) of all its landmarks.
        rgb: (m, 3) colours of the landmarks; None if the map has none.
        matches: (k,) rows of the query's matches whose landmarks it sees.
        at: (k, 2) its keypoints of these.
    """

    name: str
    color: Color
    left: int
    panel: _Panel
    preview: NDArray[np.uint8] | None
    keypoints: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None
    matches: NDArray[np.int64]
    at: NDArray[np.float32]


def draw_overlay(
    photo: Photo, opened: Map, look: Look, answer: Outcome, inliers: NDArray[np.bool_]
) -> bytes:
    """Draw a query's matches beside the photos of the map that they were found in.

    Args:
        photo: the query. It is drawn in the orientation in which features were extracted.
        opened: the map. Without kept photos, keypoints are drawn on a dark background.
        look: the query's matches with the map.
        inliers: (n,) whether the best pose explains each match.

    Returns:
        A JPEG, 1600 pixels wide.
    """
    rgb, keypoints = _as_looked_at(photo, look)
    query = _fit(rgb.shape[1], rgb.shape[0], (_MARGIN, _HEAD_PX), _QUERY_BOX)
    shown = list(_shown(opened, look, query))
    bottom = max(panel.top + panel.height for panel in (query, *(s.panel for s in shown)))
    canvas = np.full((bottom + _CAPTION_PX + _FOOT_PX, _WIDTH, 3), _GROUND, dtype=np.uint8)
    _paste(canvas, query, rgb)
    for one in shown:
        _draw_seen(canvas, one)
    matched = query.place(keypoints)
    canvas = _with_lines(canvas, matched, shown, inliers)
    _draw_marks(canvas, matched, inliers, radius=3.5)
    for one in shown:
        _draw_marks(canvas, one.panel.place(one.at), inliers[one.matches], radius=1.5)
        _caption(canvas, one, inliers)
    _headline(canvas, opened, look, answer, inliers)
    _legend(canvas, answer, len(look.evidence.retrieved) - len(shown))
    bgr = cv2.cvtColor(canvas, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _as_looked_at(photo: Photo, look: Look) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The pixels that features were extracted from, and the keypoints of the matches in them."""
    pixels = look.matches.pixels * look.reduced
    turn = turn_of(photo.exif_orientation) if look.evidence.read_as is ReadAs.UPRIGHT else 1
    turned = upright_from_stored(pixels, turn, photo.width, photo.height)
    return upright(photo.rgb, turn), turned.astype(np.float64)


def _fit(width: int, height: int, corner: tuple[int, int], box: tuple[int, int]) -> _Panel:
    """The largest panel for a photo of this size that fits into a box, centred in its width."""
    scale = min(box[0] / width, box[1] / height)
    shown = max(1, round(width * scale)), max(1, round(height * scale))
    left = corner[0] + (box[0] - shown[0]) // 2
    return _Panel(left, corner[1], *shown, (shown[0] / width, shown[1] / height))


def _shown(opened: Map, look: Look, query: _Panel) -> Iterator[_Shown]:
    """The best retrieved photos that fit beside the query."""
    row_of = {record.name: row for row, record in enumerate(opened.images)}
    retrieved = look.evidence.retrieved
    pitch = _CELL_HEIGHT + _CAPTION_PX
    num_rows = max(3, min(_MAX_ROWS, (query.height + _CAPTION_PX) // pitch))
    for rank, name in enumerate([r.name for r in retrieved[: num_rows * _COLUMNS]]):
        row = row_of[name]
        camera = opened.cameras[opened.images[row].camera]
        left = 2 * _MARGIN + _QUERY_BOX[0] + rank % _COLUMNS * (_CELL_WIDTH + _GAP)
        corner = left, _HEAD_PX + rank // _COLUMNS * pitch
        start, stop = opened.observation_offsets[row], opened.observation_offsets[row + 1]
        observed = opened.observation_landmarks[start:stop].astype(np.int64)
        keypoints = opened.keypoints(row)
        _, matches, places = np.intersect1d(look.landmarks, observed, return_indices=True)
        yield _Shown(
            name=f"{rank + 1}  {name}",
            color=_LINES[rank % len(_LINES)],
            left=left,
            panel=_fit(camera.width, camera.height, corner, (_CELL_WIDTH, _CELL_HEIGHT)),
            preview=read_preview(opened, row),
            keypoints=keypoints,
            rgb=None if opened.colors is None else opened.colors[observed],
            matches=matches,
            at=keypoints[places],
        )


def read_preview(opened: Map, row: int) -> NDArray[np.uint8] | None:
    """Decode the small photo (H, W, 3) that a map keeps of a row; None when it keeps none."""
    data = opened.photo(row)
    if data is None:
        return None
    try:
        return read_photo(data, _PREVIEW_LIMITS).rgb
    except InvalidInput as error:
        raise refuse(
            "map.photo",
            field=f"{opened.ref}: {opened.images[row].name}",
            expected=error.expected,
            got=error.got,
        ) from error


def _paste(canvas: Canvas, panel: _Panel, rgb: NDArray[np.uint8], brightness: float = 1.0) -> None:
    smaller = panel.width < rgb.shape[1]
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    resized = cv2.resize(rgb, (panel.width, panel.height), interpolation=how)
    canvas[panel.rows, panel.columns] = (resized * brightness).astype(np.uint8)


def _draw_seen(canvas: Canvas, shown: _Shown) -> None:
    """Draw a photo of the map and the keypoints that it sees."""
    panel = shown.panel
    if shown.preview is None:
        canvas[panel.rows, panel.columns] = _EMPTY
    else:
        _paste(canvas, panel, shown.preview, brightness=0.7)
    inside = panel.contains(shown.keypoints)
    places = np.rint(panel.place(shown.keypoints[inside])).astype(int).tolist()
    if shown.preview is None and shown.rgb is not None:
        colors = shown.rgb[inside].tolist()
    else:
        colors = [_SEEN] * len(places)
    for (x, y), color in zip(places, colors, strict=True):
        cv2.circle(canvas, (x, y), 1 if shown.preview is None else 0, color, cv2.FILLED)


def _with_lines(
    canvas: Canvas,
    matched: NDArray[np.float64],
    shown: Sequence[_Shown],
    inliers: NDArray[np.bool_],
) -> Canvas:
    """Join the keypoints of inliers with lines, some for each photo."""
    lines = canvas.copy()
    for one in shown:
        right = np.flatnonzero(inliers[one.matches])
        chosen = right[np.linspace(0, len(right) - 1, min(len(right), _MAX_LINES)).astype(int)]
        starts, ends = matched[one.matches[chosen]], one.panel.place(one.at[chosen])
        for start, end in zip(_fixed(starts), _fixed(ends), strict=True):
            cv2.line(lines, start, end, one.color, 1, cv2.LINE_AA, _SHIFT)
    # Half transparent, so that the photos stay visible where many lines cross.
    return np.asarray(cv2.addWeighted(lines, 0.6, canvas, 0.4, 0.0), dtype=np.uint8)


def _draw_marks(
    canvas: Canvas, places: NDArray[np.float64], inliers: NDArray[np.bool_], *, radius: float
) -> None:
    """Draw outliers as red crosses and, above them, inliers as green rings."""
    arm = round(radius * (1 << _SHIFT))
    for x, y in _fixed(places[~inliers]):
        for dx, dy in ((arm, arm), (arm, -arm)):
            ends = (x - dx, y - dy), (x + dx, y + dy)
            cv2.line(canvas, *ends, _OUTLIER, 1, cv2.LINE_AA, _SHIFT)
    for center in _fixed(places[inliers]):
        cv2.circle(canvas, center, arm, _INLIER, 1, cv2.LINE_AA, _SHIFT)


def _fixed(places: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Places (n, 2) as OpenCV's fixed-point numbers, clipped to the range of a canvas."""
    near = np.clip(places, -10_000, 10_000)
    return [(x, y) for x, y in np.rint(near * (1 << _SHIFT)).astype(int).tolist()]


def _caption(canvas: Canvas, shown: _Shown, inliers: NDArray[np.bool_]) -> None:
    num_inliers = int(inliers[shown.matches].sum())
    sees = f"sees {len(shown.keypoints)} points, {len(shown.matches)} of the matches, "
    x, y = shown.left, shown.panel.top + shown.panel.height
    canvas[y : y + 40, x : x + _CELL_WIDTH] = _GROUND  # no lines behind words
    _write(canvas, shown.name, (x, y + 17), shown.color, 0.45, _CELL_WIDTH)
    _write(canvas, f"{sees}{num_inliers} inliers", (x, y + 35), _DIM, 0.42, _CELL_WIDTH)


def _headline(
    canvas: Canvas, opened: Map, look: Look, answer: Outcome, inliers: NDArray[np.bool_]
) -> None:
    counts = f"{int(inliers.sum())} of {len(inliers)} matches agree with"
    room = _WIDTH - 2 * _MARGIN
    if isinstance(answer, NotLocalized | Refusal):
        title = f"not localized: {answer.reason}, {counts} the best pose"
        _write(canvas, title, (_MARGIN, 40), _OUTLIER, 0.9, room)
        detail = f"{answer.message} (stage {answer.stage})"
    else:
        _write(canvas, f"localized: {counts} the pose", (_MARGIN, 40), _INLIER, 0.9, room)
        unit = "m" if opened.manifest.world.metric else "units"
        stds = ", ".join(f"{value:.2g}" for value in answer.position_std)
        detail = (
            f"standard deviation of the position in x, y, z: {stds} {unit}, {answer.uncertainty}"
        )
        if answer.probability is not None:
            detail += f"; right with a probability of {answer.probability:.2f}"
    _write(canvas, detail, (_MARGIN, 68), _TEXT, 0.5, room)
    evidence = look.evidence
    facts = f"map {opened.ref}; {evidence.num_keypoints} keypoints; {len(evidence.retrieved)} "
    facts += f"photos of the map asked; {evidence.camera.width} x {evidence.camera.height} pixels"
    _write(canvas, facts, (_MARGIN, 90), _DIM, 0.5, room)


def _legend(canvas: Canvas, answer: Outcome, num_hidden: int) -> None:
    is_refused = isinstance(answer, NotLocalized | Refusal)
    pose = "the best pose, which was refused," if is_refused else "the pose"
    text = (
        f"green ring: {pose} explains the match; red cross: it does not; "
        f"lines: up to {_MAX_LINES} of the inliers that a photo of the map sees"
    )
    if num_hidden > 0:
        text += f"; {num_hidden} more photos not shown"
    y = canvas.shape[0] - _MARGIN
    _write(canvas, text, (_MARGIN, y), _DIM, 0.5, _WIDTH - 2 * _MARGIN)


def _write(
    canvas: Canvas, text: str, at: tuple[int, int], color: Color, size: float, room: int
) -> None:
    """Write one line, shortened in its middle when it is wider than ``room`` pixels."""
    text = "".join(char if char.isprintable() else "?" for char in text)
    kept = min(len(text), _MAX_TEXT)
    while kept > 8 and cv2.getTextSize(_shortened(text, kept), _FONT, size, 1)[0][0] > room:
        kept -= 1
    cv2.putText(canvas, _shortened(text, kept), at, _FONT, size, color, 1, cv2.LINE_AA)


def _shortened(text: str, kept: int) -> str:
    if kept >= len(text):
        return text
    return f"{text[: kept // 2]}...{text[kept // 2 - kept :]}"

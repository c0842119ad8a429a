"""Figures of answers and maps, for notebooks: the last value of a cell is shown.

They need the extra ``notebook``: matplotlib, and plotly for the view in 3D. What they return can be
changed before it is shown or saved: ``figure.axes`` of matplotlib's, ``update_layout`` of plotly's.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.archive import Map
from visloc.drawing.detail_levels import detail_order
from visloc.drawing.matches_picture import draw_overlay, read_preview
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.in_process import LocalMap, PhotoResult, require
from visloc.photos.reading import read_photo_file
from visloc.pose.reprojection import project
from visloc.types import Localized

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from plotly.graph_objects import Figure as Figure3D

    from visloc.drawing.shown_figure import ShownFigure

_COLUMNS = 5
_PosedCamera = tuple[str, Camera, Pose]  # the name of its photo, and cam_from_world
# Colours that also differ for red-green colour blindness (Okabe and Ito).
_MAPPING, _LOCALIZED, _TRUE = "#0072b2", "#009e73", "#e69f00"
# A camera's side in the view in 3D, of the diagonal that holds the inner landmarks.
_CAMERA_SIZE = 0.02
_INNER_PERCENT = (2, 98)
_LINE = 12  # points of a camera's line


def matches(result: PhotoResult) -> Image.Image:
    """Draw a photo's matches beside the mapping photos that they were found in.

    Green rings are inliers, red crosses are outliers. The photo is matched once more.
    """
    photo, look, inliers = result.look_again()
    assert result.answer is not None  # look_again raises its error
    picture = draw_overlay(photo, result.map.archive, look, result.answer, inliers)
    return Image.open(io.BytesIO(picture))


def reprojections(result: PhotoResult) -> ShownFigure:
    """Draw where the pose puts the landmarks of the inliers, and their errors in pixels."""
    answer = result.answer
    if not isinstance(answer, Localized):
        raise refuse("notebook.no_pose", field=result.name)
    figure, ((left, right),) = _subplots(1, 2, (11.0, 4.2), width_ratios=(1.4, 1.0))
    errors = reprojection_errors(answer)
    left.imshow(read_photo_file(result.path).rgb)
    sizes = np.hypot(*errors.T)
    keypoints = answer.inlier_keypoints
    dots = left.scatter(*keypoints.T, c=sizes, s=10, cmap="viridis", linewidths=0)
    figure.colorbar(dots, ax=left, label="reprojection error, px")
    left.set_axis_off()
    left.set_title(f"{_plain(result.name)}: {len(sizes)} inliers", fontsize=10)
    right.scatter(*errors.T, s=6, color=_MAPPING, alpha=0.5, linewidths=0)
    right.axhline(0, color="grey", linewidth=0.6)
    right.axvline(0, color="grey", linewidth=0.6)
    right.set_aspect("equal")
    right.invert_yaxis()  # as in the photo
    right.set_xlabel("x, px")
    right.set_ylabel("y, px")
    right.set_title(f"landmark less keypoint: median {np.median(sizes):.2f} px", fontsize=10)
    return figure


def reprojection_errors(answer: Localized) -> NDArray[np.float64]:
    """Return the projected landmark less the keypoint (n, 2) of each inlier, in stored pixels."""
    camera = answer.evidence.camera
    projected = project(camera, answer.cam_from_world.apply(answer.inlier_points))
    return np.asarray(projected - answer.inlier_keypoints, dtype=np.float64)


def retrieval(result: PhotoResult, most: int = 9) -> ShownFigure:
    """Draw a photo and the mapping photos that retrieval found for it, best first.

    A map that keeps no photos shows the keypoints of their landmarks instead.
    """
    if result.answer is None:
        assert result.error is not None  # one of both is there
        raise result.error
    retrieved, opened = result.answer.evidence.retrieved[:most], result.map.archive
    row_of = {record.name: row for row, record in enumerate(opened.images)}
    num_rows = -(-(1 + len(retrieved)) // _COLUMNS)
    figure, cells = _subplots(num_rows, _COLUMNS, (11.0, 2.2 * num_rows))
    cells = cells.ravel()
    for axes in cells:
        axes.set_axis_off()
    cells[0].imshow(read_photo_file(result.path).rgb)
    cells[0].set_title(f"query: {_plain(result.name)}", fontsize=8)
    for rank, (axes, photo) in enumerate(zip(cells[1:], retrieved, strict=False), start=1):
        _draw_mapping_photo(axes, opened, row_of[photo.name])
        axes.set_title(f"{rank}: {_plain(photo.name)}\nscore {photo.score:.3f}", fontsize=8)
    return figure


def _draw_mapping_photo(axes: Axes, opened: Map, row: int) -> None:
    """Draw a photo that the map keeps, or else the keypoints of its landmarks."""
    preview, camera = read_preview(opened, row), opened.cameras[opened.images[row].camera]
    if preview is None:
        x, y = opened.keypoints(row).T
        axes.scatter(x, y, s=0.5, color=_MAPPING, linewidths=0)
        axes.set_aspect("equal")
        axes.set_xlim(0, camera.width)
        axes.set_ylim(camera.height, 0)
    else:
        axes.imshow(preview)


def map_3d(
    opened: LocalMap, results: Iterable[PhotoResult] = (), most_landmarks: int = 20_000
) -> Figure3D:
    """Draw a map with its cameras, and where photos were localized, to be turned with the mouse.

    Blue cameras are mapping photos, green ones localized photos, orange ones their true poses.

    Args:
        results: of photos; those without a pose are left out.
        most_landmarks: landmarks to draw. A part of them samples the map evenly.
    """
    require("plotly")
    from plotly import graph_objects

    archive = opened.archive
    mapping = _mapping_cameras(archive)
    shown, size = _landmarks_in_view(archive, most_landmarks)
    points = archive.landmarks[shown].astype(np.float64) + np.asarray(archive.manifest.world.origin)
    marker: dict[str, Any] = {"size": 1, "color": "grey"}
    if archive.colors is not None:
        marker["color"] = [f"rgb({r},{g},{b})" for r, g, b in archive.colors[shown].tolist()]
    figure = graph_objects.Figure(layout={"height": 650, "legend": {"x": 0}})
    figure.update_scenes(aspectmode="data", camera=_view(archive, mapping))
    x, y, z = points.T
    figure.add_scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name="landmarks")
    found = [result for result in results if result.pose is not None]
    for name, color, cameras in (
        ("mapping photos", _MAPPING, mapping),
        ("localized", _LOCALIZED, [_camera_of(result, result.pose) for result in found]),
        ("true poses", _TRUE, [_camera_of(r, r.truth) for r in found if r.truth is not None]),
    ):
        if cameras:
            x, y, z = np.concatenate([_camera_line(pose, c, size) for _, c, pose in cameras]).T
            line = {"x": x, "y": y, "z": z, "mode": "lines", "line": {"color": color}}
            texts = [photo for photo, _, _ in cameras for _ in range(_LINE)]
            figure.add_scatter3d(name=name, text=texts, **line)
    return figure


def errors(results: Mapping[str, Sequence[PhotoResult]] | Sequence[PhotoResult]) -> ShownFigure:
    """Draw which share of the photos has a pose error of at most so much.

    A photo without a pose never counts, so a curve ends at the share that was localized.

    Args:
        results: of one folder, or of several by name. Photos without a true pose are left out.
    """
    named = results if isinstance(results, Mapping) else {"": results}
    figure, (both,) = _subplots(1, 2, (11.0, 3.8), sharey=True)
    for name, photos in named.items():
        known = [photo.pose_error for photo in photos if photo.truth is not None]
        if not known:
            raise refuse("notebook.no_truth", field=name or None)
        found = np.array([error for error in known if error is not None]).reshape(-1, 2)
        share = 100 * np.arange(1, len(found) + 1) / len(known)
        for axes, column in zip(both, found.T, strict=True):
            axes.step(np.sort(column), share, where="post", label=_plain(name), marker=".")
    for axes, label in zip(both, ("position error", "orientation error, degrees"), strict=True):
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter("")  # its labels overlap
        axes.xaxis.set_major_formatter("{x:g}")
        low, high = np.log10(axes.get_xlim())
        axes.set_xlim(10 ** np.floor(low), 10 ** np.ceil(high))
        axes.set_xlabel(label)
        axes.set_ylim(0, 103)
        axes.grid(color="#e0e0e0")
    both[0].set_ylabel("photos, %")
    if isinstance(results, Mapping):
        both[0].legend()
    return figure


def _landmarks_in_view(archive: Map, most: int) -> tuple[NDArray[np.int64], float]:
    """Choose rows of landmarks that sample the map evenly, without those far outside.

    Returns:
        The rows, and the size of a camera.
    """
    landmarks = np.asarray(archive.landmarks)
    low, high = np.percentile(landmarks, _INNER_PERCENT, axis=0)
    inside = ((landmarks > 1.5 * low - 0.5 * high) & (landmarks < 1.5 * high - 0.5 * low)).all(1)
    rows = np.flatnonzero(inside)
    rows = rows[detail_order(landmarks[rows])[:most]]
    return np.sort(rows), _CAMERA_SIZE * float(np.linalg.norm(high - low))


def _view(archive: Map, mapping: Sequence[_PosedCamera]) -> dict[str, dict[str, float]]:
    """Look down a little: against gravity is up, or else what most photos take for up."""
    down = archive.gravity
    if down is None:
        down = np.mean([pose.rotation[1] for _, _, pose in mapping], axis=0)
    up = -down / max(float(np.linalg.norm(down)), 1e-9)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    eye = 0.9 * up + 1.4 * side / np.linalg.norm(side)
    return {k: dict(zip("xyz", v.tolist(), strict=True)) for k, v in (("up", up), ("eye", eye))}


def _camera_line(cam_from_world: Pose, camera: Camera, size: float) -> NDArray[np.float64]:
    """Return a line (_LINE, 3) in the world around a camera, with a gap (NaN) after it."""
    x, y = np.array([camera.width, camera.height]) / (2 * camera.focal_length)
    o = np.zeros(3)
    a, b, c, d = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]])
    line = np.array([a, b, c, d, a, o, b, o, c, o, d]) * size
    return np.concatenate([cam_from_world.inverse().apply(line), np.full((1, 3), np.nan)])


def _mapping_cameras(archive: Map) -> list[_PosedCamera]:
    return [
        (image.name, archive.cameras[image.camera], Pose.from_quaternion(row[:4], row[4:]))
        for image, row in zip(archive.images, archive.image_poses, strict=True)
    ]


def _camera_of(result: PhotoResult, pose: Pose | None) -> _PosedCamera:
    assert pose is not None  # those without are left out
    assert result.answer is not None  # it has a pose
    return result.name, result.answer.evidence.camera, pose


def _subplots(
    num_rows: int, num_columns: int, size: tuple[float, float], **options: Any
) -> tuple[ShownFigure, NDArray[Any]]:
    require("matplotlib")
    from visloc.drawing.shown_figure import ShownFigure

    figure = ShownFigure(figsize=size, layout="constrained")
    return figure, figure.subplots(num_rows, num_columns, squeeze=False, **options)


def _plain(text: str) -> str:
    """Keep matplotlib from taking a name for a formula."""
    return text.replace("$", r"\$")

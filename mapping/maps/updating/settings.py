"""What an update is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mapping.methods.rgbd import DepthSettings
from visloc.archive import Map
from visloc.archive.schema import ID_PATTERN
from visloc.errors import refuse
from visloc.geometry import PixelOrigin
from visloc.types import Inference

# What is known of where the photos were taken.
POSES = ("tie", "given", "localize")
# How landmarks of the new photos are made.
METHODS = ("rgbd", "sfm")


@dataclass(frozen=True, slots=True)
class UpdateSettings:
    """What an update is made of.

    Attributes:
        dataset: kapture folder of the new capture.
        map_ref: the map: id, id@version, or a folder.
        maps_dir: folder of maps.
        poses: a name of ``POSES``: ``tie``: of the dataset, in a frame of its own; ``given``: of
            the dataset, in the map's frame; ``localize``: those that the map gives each photo.
        method: a name of ``METHODS``; None for the one that made the map.
        capture: what comes before the names of the photos, to tell captures apart.
        metric: whether a unit of the dataset's poses is a metre.
        depth_scale: metres per unit of 16-bit PNG depth.
        depth_sensor: the depth sensor to use, when several go with a photo.
        features_dir: where ready-made features lie, when not in the dataset.
        pixel_origin: what the dataset's principal points and ready-made keypoints count from.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        workers: processes that work on photos and pairs.
    """

    dataset: Path
    map_ref: str
    maps_dir: Path
    poses: str = POSES[0]
    method: str | None = None
    capture: str | None = None
    metric: bool = True
    depth_scale: float = DepthSettings().depth_scale
    depth_sensor: str | None = None
    features_dir: Path | None = None
    pixel_origin: PixelOrigin = PixelOrigin.CORNER
    weights_dir: Path | None = None
    inference: Inference = Inference.AUTO
    workers: int = 1


def check_settings(settings: UpdateSettings) -> None:
    """Refuse what would otherwise fail after long work.

    Raises:
        InvalidInput: ``update.poses``, ``update.method``, ``update.capture``.
    """
    for option, value, known in (
        ("poses", settings.poses, POSES),
        ("method", settings.method, METHODS),
    ):
        if value is not None and value not in known:
            raise refuse(f"update.{option}", field=f"--{option}", expected=known, got=value)
    if settings.capture is not None and not ID_PATTERN.fullmatch(settings.capture):
        raise refuse("update.capture", field="--capture", got=settings.capture)
    if not (settings.depth_scale > 0 and settings.depth_scale < float("inf")):
        raise refuse("update.depth_scale", field="--depth-scale", got=settings.depth_scale)


def method_for(settings: UpdateSettings, opened: Map) -> str:
    """Return how landmarks are made: as asked, else as those of the map.

    Raises:
        InvalidInput: ``update.unit`` when depth has no unit in the map.
    """
    made_by = opened.manifest.method.name
    method = settings.method or (made_by if made_by in METHODS else "sfm")
    if method == "rgbd" and settings.poses != "tie" and not opened.manifest.world.metric:
        raise refuse("update.unit", field="--poses", got=settings.poses)
    return method


def refuse_strange_settings(opened: Map) -> None:
    """Refuse a map whose settings, which may be of any software, are not what an update reads.

    Raises:
        Conflict: ``update.settings``.
    """
    settings = opened.manifest.method.settings
    voxel_size = settings.get("voxel_size", DepthSettings().voxel_size)
    is_length = (
        isinstance(voxel_size, int | float)
        and not isinstance(voxel_size, bool)
        and 0 < voxel_size < float("inf")
    )
    for name, known, expected in (
        ("updates", isinstance(settings.get("updates", []), list), "a list of updates"),
        ("voxel_size", is_length, "a length, more than 0"),
    ):
        if not known:
            raise refuse(
                "update.settings",
                field=name,
                expected=expected,
                got=str(settings[name]),
                ref=opened.ref,
                name=name,
            )


def refuse_few(count: int) -> None:
    """Refuse to match fewer photos with each other than two.

    Raises:
        InvalidInput: ``update.photos_few``.
    """
    if count < 2:
        raise refuse("update.photos_few", field="--method", got=f"{count} to be matched")

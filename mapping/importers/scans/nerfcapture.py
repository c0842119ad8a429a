"""NeRFCapture and SplaTAM: ``transforms.json`` whose frames name their depth by ``depth_path``.

Format: DatasetWriter.swift and nerfcapture_dataset.py of jc211/NeRFCapture. Cameras and poses are
as nerfstudio's. Depth is a 16-bit PNG whose unit ``integer_depth_scale`` gives, in metres, or a PNG
whose four bytes of a pixel are a float32, in metres.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mapping.importers import nerfstudio
from mapping.importers.model import ImportedModel
from mapping.importers.reading.json_fields import JsonValue, read_json
from mapping.importers.reading.photo_names import photo_names
from mapping.importers.scans.frames import ScanFrame, link, photos_folder, scan_model
from mapping.stages.depth import read_depth
from visloc.errors import refuse
from visloc.geometry import Camera
from visloc.photo_formats import MALFORMED, png_samples

_DEPTH, _SCALE = "depth_path", "integer_depth_scale"
_FARTHEST_M, _LEAST_KNOWN = 100.0, 0.5
_RGBA = (8, 6)  # bits and colour type of PNG


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read a recording; photos are linked from, and depth maps written to, a folder of their own.

    Args:
        path: the folder of ``transforms.json``.
        photos: that folder; None makes ``<path>_photos`` beside it.

    Raises:
        DatasetError: as ``nerfstudio.read``.
    """
    top = read_json(path / "transforms.json")
    scale, applied = top.get(_SCALE), top.get("applied_scale")
    unit = None if scale is None else scale.number()
    without_depth = {key: value for key, value in top.value.items() if key != _SCALE}
    without_depth["frames"] = [
        {key: value for key, value in frame.value.items() if key != _DEPTH}
        for frame in top["frames"].elements()
        if frame.fields()
    ]
    model = nerfstudio.read_recording(JsonValue(without_depth, top.file), path)

    def depth(file: Path, camera: Camera) -> NDArray[np.float32]:
        return _metres(file, camera, unit)

    with photos_folder(path, photos) as (folder, notes):
        frames = []
        for frame, image in zip(top["frames"].elements(), model.images, strict=True):
            camera = model.sensors[image.sensor].camera
            assert camera is not None  # of every photo of nerfstudio's
            assert image.cam_from_world is not None
            link(path / image.name, folder / image.name)
            frames.append(
                ScanFrame(image.name, camera, image.cam_from_world, _depth_file(frame, path))
            )
        notes += [note for note in model.notes if note != nerfstudio.UNKNOWN_UNIT]
        metric = applied is None or applied.number() == 1
        return scan_model(frames, folder, notes, depth, metric=metric)


def _depth_file(frame: JsonValue, folder: Path) -> Path | None:
    value = frame.get(_DEPTH)
    if value is None or value.value is None:
        return None
    (name,), _ = photo_names([(value.text(), value.where)], folder, folder)
    return folder / name


def _metres(file: Path, camera: Camera, unit: float | None) -> NDArray[np.float32]:
    data = file.read_bytes()
    if png_samples(data) != _RGBA:
        if unit is None:
            raise refuse("depth.scale", "nothing gives its unit", field=_SCALE)
        return read_depth(file, camera, unit)
    try:
        pixels = np.asarray(Image.open(BytesIO(data), formats=("PNG",)), np.uint8)
    except MALFORMED as error:
        raise refuse("depth.damaged", field=str(file), got=str(error)) from error
    metres = np.ascontiguousarray(pixels).view("<f4")[..., 0].copy()
    metres[~((metres > 0) & (metres < _FARTHEST_M))] = np.nan  # also of NaN
    if np.isfinite(metres).mean() < _LEAST_KNOWN:
        raise refuse("depth.format", "its colours are not the bytes of metres", field=str(file))
    return metres

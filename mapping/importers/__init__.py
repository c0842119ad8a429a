"""Foreign reconstructions and photos as kapture datasets, by format.

A further format is one file with ``read(path, photos)`` and one line in the registry below,
or, of an extension, in ``pyproject.toml``.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

from mapping.importers.dataset import MASKS, write_imported
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.progress import Progress, one_step
from mapping.stages.outputs import refuse_existing
from mapping.stages.work_folder import exclusive
from visloc import extensions as extension_points
from visloc.archive import MapStore
from visloc.errors import refuse
from visloc.extensions import extensions, load

__all__ = [
    "IMPORTERS",
    "MASKS",
    "ImportSummary",
    "ImportedImage",
    "ImportedModel",
    "import_dataset",
    "imported",
    "importer_names",
    "read_model",
    "write_imported",
]

# name -> module and function (path, folder of photos or None) -> ImportedModel
IMPORTERS: Mapping[str, tuple[str, str]] = {
    "colmap": ("mapping.importers.colmap", "read"),
    "images": ("mapping.importers.images", "read"),
    "nerfstudio": ("mapping.importers.nerfstudio", "read"),
}


def importer_names() -> list[str]:
    """Return the names of all formats, those of extensions included."""
    return sorted({*IMPORTERS, *extensions(extension_points.IMPORTERS)})


def _untold(_stage: str, _done: int, _total: int) -> None:
    """Show no progress."""


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """The result of an import.

    Attributes:
        cameras: cameras, those of unknown intrinsics included.
        depth_scale: units of the world in one unit of the depth maps.
        masks: masks of photos, in the folder ``MASKS`` of the dataset.
        points: 3D points.
        observations: keypoints that see a point.
        keypoints_type: folder name of the keypoints; None without.
        with_descriptors: whether every photo with keypoints has descriptors for them.
        metric: whether a unit of the world is known to be a metre.
        notes: what was left out or assumed, one sentence each.
    """

    images: int
    posed: int
    cameras: int
    depth_maps: int
    depth_scale: float
    masks: int
    gnss: int
    points: int
    observations: int
    keypoints_type: str | None
    with_descriptors: bool
    metric: bool
    notes: tuple[str, ...]


@contextmanager
def imported(
    name: str,
    path: Path,
    maps_dir: Path,
    map_id: str,
    photos: Path | None,
    progress: Progress = _untold,
) -> Iterator[tuple[Path, ImportSummary]]:
    """Have a foreign reconstruction as a dataset while a map is made of it."""
    MapStore(maps_dir).versions(map_id)  # refuses what is not an id
    # Ids begin with a letter or digit: no work folder of a build has this name.
    dataset = maps_dir / ".work" / f".imported-{map_id}"
    with exclusive(dataset.with_name(f"{dataset.name}.lock")):
        shutil.rmtree(dataset, ignore_errors=True)  # of an import that was killed
        summary = import_dataset(name, path, dataset, photos, progress)
        try:
            yield dataset, summary
        finally:
            shutil.rmtree(dataset, ignore_errors=True)


def read_model(
    name: str, path: Path, photos: Path | None = None, progress: Progress = _untold
) -> ImportedModel:
    """Read a foreign reconstruction.

    Args:
        path: the file or folder that the format consists of.
        photos: the folder that names of photos are relative to; None takes the usual place.
        progress: told the stage, how much of it is done, and how much there is.
    """
    if name not in importer_names():
        raise refuse("import.unknown_format", field="FORMAT", expected=importer_names(), got=name)
    read: Callable[..., ImportedModel]
    if name in IMPORTERS:
        module, function = IMPORTERS[name]
        read = getattr(import_module(module), function)
    else:
        read = load(extensions(extension_points.IMPORTERS)[name])
    makes_photos = getattr(read, "makes_photos", False)  # a reader that writes them
    if photos is not None and not photos.is_dir() and (not makes_photos or photos.exists()):
        raise refuse("import.photos", field="--photos", got=str(photos))
    if name == "images":  # the only one that decodes photos, which takes long
        return read(path, photos, partial(progress, "photos"))
    with one_step(progress, "reading"):
        return read(path, photos)


def import_dataset(
    name: str,
    path: Path,
    output: Path,
    photos: Path | None = None,
    progress: Progress = _untold,
) -> ImportSummary:
    """Read a foreign reconstruction and write it as a kapture 1.1 dataset.

    Args:
        path: the file or folder that the format consists of.
        output: the dataset to make; it must not exist, and does not if this fails.
        photos: the folder that names of photos are relative to; None takes the usual place.
        progress: told the stage, how much of it is done, and how much there is.
    """
    refuse_existing(output, "import.exists")  # before the long work
    model = read_model(name, path, photos, progress)
    with one_step(progress, "dataset"):
        notes = write_imported(model, output)
    with_keypoints = [image for image in model.images if image.keypoints is not None]
    kinds = [sensor.kind for sensor in model.sensors.values()]
    return ImportSummary(
        images=len(model.images),
        posed=sum(image.cam_from_world is not None for image in model.images),
        cameras=kinds.count("camera"),
        depth_maps=sum(image.depth is not None for image in model.images),
        depth_scale=model.depth_scale,
        masks=sum(image.mask is not None for image in model.images),
        gnss=len(model.gnss),
        points=len(model.points),
        observations=len(model.observations),
        keypoints_type=model.keypoints_type if with_keypoints else None,
        with_descriptors=bool(with_keypoints)
        and all(image.descriptors is not None for image in with_keypoints),
        metric=model.metric,
        notes=notes,
    )

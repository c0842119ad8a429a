"""An imported model as a kapture dataset: checked whole, then written whole."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path

import numpy as np

from mapping.importers.left_out import list_path, notes_on, write_list
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import is_stored_turned, photo_size_as_read
from mapping.stages.outputs import complete_output
from visloc.errors import refuse
from visloc.kapture import (
    Dataset,
    FileRecord,
    Reconstruction,
    write_dataset,
    write_keypoints,
    write_local_features,
    write_reconstruction,
)
from visloc.kapture.text import is_folder_name, is_path_field

MASKS = "masks"  # the folder of a dataset for ``mapping build --masks``
_NAMED = 3  # how many names an error or note lists


def depth_sensor_id(sensor: str) -> str:
    """Return the id of the sensor that the depth maps of a camera's photos belong to.

    They have the pose of their photo.
    """
    return f"{sensor}_depth"


def write_imported(model: ImportedModel, output: Path) -> tuple[str, ...]:
    """Write a kapture 1.1 dataset: sensors, poses, records, keypoints, descriptors and points.

    Photos are not copied: ``sensors/records_data`` is a symbolic link to their folder, and
    ``masks`` holds links to their masks, under the names that a build looks for. A photo without
    its file stays in the dataset, with a note. Files that are not used are listed beside the
    dataset, see ``left_out.list_path``.

    Args:
        model: the model. The depth map of a photo is of the sensor ``depth_sensor_id`` of the
            photo's camera.
        output: the folder to make; it must not exist, and does not if this fails.

    Returns:
        The model's notes, and those on files that are missing or left out.
    """
    _check_images(model)
    _check_features(model)
    _check_points(model)
    notes = (*model.notes, *notes_on(model.left_out), *_check_photos(model))
    _check_sizes(model)
    with complete_output(output, "import.exists") as root:
        sensors = root / "sensors"
        sensors.mkdir(parents=True)
        if model.photos is not None:
            (sensors / "records_data").symlink_to(model.photos.resolve())
            _link_masks(model.images, model.photos.resolve(), root / MASKS)
        write_dataset(_dataset(model, root))
        _write_features(model, root)
        if len(model.points):
            write_reconstruction(root, _reconstruction(model))
    return (*notes, *write_list(model.left_out, list_path(output)))


def _dataset(model: ImportedModel, root: Path) -> Dataset:
    poses = {}
    depth_maps = []
    for image in model.images:
        pose = image.cam_from_world
        if pose is not None:
            poses[image.timestamp, image.sensor] = pose
        if image.depth is not None:
            depth_sensor = depth_sensor_id(image.sensor)
            depth_maps.append(FileRecord(image.timestamp, depth_sensor, image.depth))
            if pose is not None:
                poses[image.timestamp, depth_sensor] = pose
    return Dataset(
        root=root,
        sensors=model.sensors,
        rigs={},
        trajectories=poses,
        images=_sorted(FileRecord(i.timestamp, i.sensor, i.name) for i in model.images),
        depth_maps=_sorted(depth_maps),
        gnss=tuple(sorted(model.gnss, key=lambda record: (record.timestamp, record.sensor_id))),
    )


def _link_masks(images: Iterable[ImportedImage], photos: Path, folder: Path) -> None:
    for image in images:
        if image.mask is not None:
            link = folder / f"{image.name}.png"
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(photos / image.mask)


def _sorted(records: Iterable[FileRecord]) -> tuple[FileRecord, ...]:
    return tuple(sorted(records, key=lambda r: (r.timestamp, r.sensor_id, r.path)))


def _write_features(model: ImportedModel, root: Path) -> None:
    kind = model.keypoints_type
    for image in model.images:
        if image.keypoints is None:
            continue
        if image.descriptors is None:
            write_keypoints(root, kind, image.name, image.keypoints, name=kind)
        else:
            write_local_features(
                root, kind, image.name, image.keypoints, image.descriptors, name=kind
            )


def _reconstruction(model: ImportedModel) -> Reconstruction:
    observing, rows = np.unique(model.observations[:, 1], return_inverse=True)
    observations = model.observations.copy()
    observations[:, 1] = rows.reshape(-1)
    return Reconstruction(
        points=model.points,
        colors=model.colors if len(model.colors) else None,
        keypoints_type=model.keypoints_type if len(observations) else None,
        images=tuple(model.images[index].name for index in observing),
        observations=observations,
    )


def _check_images(model: ImportedModel) -> None:
    if not model.images:
        raise refuse("import.empty", expected="photos")
    for image in model.images:
        _check_path(image.name, image.name)
        _check_sensor(model, image, image.sensor, "camera")
        if image.depth is not None:
            _check_path(image.depth, image.name)
            _check_sensor(model, image, depth_sensor_id(image.sensor), "depth")
    _refuse_twice(
        model.images,
        lambda image: image.name,
        "import.duplicate_image",
        "two photos have the same name",
        "every name once",
    )
    _refuse_twice(
        model.images,
        lambda image: (image.timestamp, image.sensor),
        "import.duplicate_record",
        "a camera has two photos of the same time",
        "every timestamp once per camera",
    )
    fixes = [(record.timestamp, record.sensor_id) for record in model.gnss]
    if len(set(fixes)) < len(fixes):
        raise refuse(
            "import.duplicate_record", got=next(fix for fix in fixes if fixes.count(fix) > 1)
        )


def _check_path(path: str, image: str) -> None:
    if not is_path_field(path):
        raise refuse("import.name", field=f"image {image!r}", got=path)


def _check_sensor(model: ImportedModel, image: ImportedImage, sensor: str, kind: str) -> None:
    found = model.sensors.get(sensor)
    if found is None or found.kind != kind:
        raise refuse(
            "import.sensor",
            field=f"image {image.name!r}",
            expected=(s.id for s in model.sensors.values() if s.kind == kind),
            got=sensor,
            what=kind,
        )


def _refuse_twice(
    images: Iterable[ImportedImage],
    key_of: Callable[[ImportedImage], Hashable],
    code: str,
    message: str,
    expected: str,
) -> None:
    seen: dict[Hashable, str] = {}
    for image in images:
        key = key_of(image)
        if key in seen:
            raise refuse(
                code,
                message,
                field=f"image {image.name!r}",
                expected=expected,
                got=f"also {seen[key]!r} (timestamp {image.timestamp}, camera {image.sensor!r})",
            )
        seen[key] = image.name


def _check_features(model: ImportedModel) -> None:
    if not is_folder_name(model.keypoints_type):
        raise refuse(
            "import.features",
            "this is not a valid name of a feature type",
            expected="a folder name without commas",
            got=model.keypoints_type,
        )
    kinds: dict[str, tuple[tuple[int, str], str]] = {}
    for image in model.images:
        keypoints, descriptors = image.keypoints, image.descriptors
        if keypoints is None and descriptors is None:
            continue
        where = f"image {image.name!r}"
        if keypoints is None or (descriptors is not None and len(keypoints) != len(descriptors)):
            raise refuse(
                "import.features",
                "the numbers of keypoints and descriptors differ",
                field=where,
                expected="one descriptor per keypoint",
                got=f"{0 if keypoints is None else len(keypoints)} keypoints, "
                f"{0 if descriptors is None else len(descriptors)} descriptors",
            )
        if keypoints.ndim != 2 or keypoints.shape[1] < 2 or not np.isfinite(keypoints).all():
            raise refuse(
                "import.features",
                "the keypoints are not valid",
                field=where,
                expected="(n, 2 or more) finite numbers",
                got=f"shape {keypoints.shape}",
            )
        for what, array in (("keypoints", keypoints), ("descriptors", descriptors)):
            if array is None:
                continue
            kind = (array.shape[1], array.dtype.name)
            known, first = kinds.setdefault(what, (kind, image.name))
            if kind != known:
                raise refuse(
                    "import.features",
                    f"the {what} differ in size or type between photos",
                    field=where,
                    expected=f"{known[0]} {known[1]} each, as of {first!r}",
                    got=f"{kind[0]} {kind[1]}",
                )


def _check_points(model: ImportedModel) -> None:
    points, colors, observations = model.points, model.colors, model.observations
    if len(colors) not in (0, len(points)):
        raise refuse(
            "import.points",
            "the numbers of points and colours differ",
            expected=f"{len(points)} colours",
            got=len(colors),
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise refuse(
            "import.points",
            "the coordinates of a point are not finite",
            field=f"point {bad[0]} (counted from 0)",
            expected="finite coordinates",
            got=points[bad[0]].tolist(),
        )
    counts = np.array([0 if i.keypoints is None else len(i.keypoints) for i in model.images])
    if not len(observations):
        return
    point, image, keypoint = observations.T
    outside = (point < 0) | (point >= len(points)) | (image < 0) | (image >= len(counts))
    outside |= (keypoint < 0) | (keypoint >= counts[np.where(outside, 0, image)])
    if outside.any():
        row = observations[np.flatnonzero(outside)[0]].tolist()
        name = model.images[row[1]].name if 0 <= row[1] < len(counts) else "?"
        raise refuse(
            "import.observations",
            field=f"image {name!r}",
            expected=f"points up to {len(points) - 1}, images up to {len(counts) - 1}, keypoints "
            "up to their number, counted from 0",
            got=f"point {row[0]}, image {row[1]}, keypoint {row[2]}",
        )


def _check_photos(model: ImportedModel) -> list[str]:
    """Return notes on photos without a file; refuse a model that cannot do without them."""
    if model.photos is None:
        missing = [image.name for image in model.images]
    else:
        # Path.is_file raises for names that are longer than a file's name can be.
        folder = model.photos
        exists = os.path.isfile
        missing = [image.name for image in model.images if not exists(folder / image.name)]
    if not missing:
        return []
    text = ", ".join(missing[:_NAMED]) + (", ..." if len(missing) > _NAMED else "")
    has_features = all(image.descriptors is not None for image in model.images)
    if len(missing) == len(model.images) and not has_features:
        raise refuse(
            "import.photos_missing",
            field="--photos" if model.photos is None else str(model.photos),
            expected=f"{len(model.images)} photos: {text}",
            got="no folder of photos" if model.photos is None else "none of them",
        )
    return [f"{len(missing)} of {len(model.images)} photos are missing: {text}"]


def _check_sizes(model: ImportedModel) -> None:
    """Refuse photos of another size than their camera: its numbers are in pixels of that size.

    A photo that is stored rotated may have the size that it has when it is upright.
    """
    if model.photos is None:
        return
    wrong = []
    for image in model.images:
        path = model.photos / image.name
        size, expected = photo_size_as_read(path), model.sensors[image.sensor].image_size
        assert expected is not None  # what a camera has
        if size in (None, expected) or (size == expected[::-1] and is_stored_turned(path)):
            continue
        wrong.append((path, size, expected, image.sensor))
    if not wrong:
        return
    path, (width, height), expected, sensor = wrong[0]
    raise refuse(
        "import.photo_size",
        field=str(path),
        expected=f"{expected[0]} x {expected[1]} pixels, as its camera {sensor}",
        got=f"{width} x {height} pixels",
        count=len(wrong),
        total=len(model.images),
    )

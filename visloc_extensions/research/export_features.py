"""Our features of a dataset in kapture's layout, so that other tools can run on them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.stages.photos import read_in_frame
from visloc.archive import FingerprintRecord, Map
from visloc.errors import refuse
from visloc.features import (
    GlobalDescriptor,
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.framing import Framing
from visloc.features.resolution import Resolution, WorkingResolution, extract_features
from visloc.kapture import (
    Dataset,
    FileRecord,
    Sensor,
    read_dataset,
    write_dataset,
    write_global_features,
    write_local_features,
)
from visloc.localization.map_view.constraints import MapGeometry
from visloc.options import Inference, ReadAs


def export_features(
    dataset_root: Path,
    output: Path,
    *,
    local_features: str,
    weights_dir: Path | None,
    inference: Inference,
    max_keypoints: int,
    global_from: Map | None,
    progress: Callable[[str, int, int], None],
) -> list[str]:
    """Write a kapture of the same photos with keypoints, descriptors and global descriptors.

    ``output`` gets the dataset's text files, a link to its photos, and
    ``reconstruction/<kind>/<name>/``. Keypoints are x, y, scale in pixels; the centre of the
    top-left pixel is (0.5, 0.5). Photos finished by an earlier run are kept.

    Args:
        output: folder to make, or one that an earlier run with the same settings left.
        global_from: a map whose global descriptors are computed for the photos. Its local
            features must be the same and as many, because ``localvlad`` is made of them.

    Returns:
        The names of photos that are listed but absent; they have no features.
    """
    dataset = read_dataset(dataset_root)
    extractor = make_local_features(local_features, weights_dir, inference)
    descriptors = {}
    if global_from is not None:
        _refuse_other_features(global_from, extractor, max_keypoints)
        for features in global_from.manifest.global_features:
            name = features.fingerprint.name
            descriptor = make_global_descriptor(name, weights_dir, inference)
            descriptors[name] = (descriptor, global_from.global_models[name])
    _write_records(dataset, output)
    reconstruction = output / "reconstruction"
    settings = {
        "local_features": FingerprintRecord.of(extractor.fingerprint).model_dump(),
        "computed_with": extractor.computed_with,
        "max_keypoints": max_keypoints,
        "read_as": ReadAs.UPRIGHT,
        "global_from": global_from and global_from.manifest.content_hash,
    }
    _claim(reconstruction / f"{local_features}.json", settings)
    resolution = _resolution_of(dataset, extractor, global_from)
    absent = []
    for done, record in enumerate(dataset.images, 1):
        if not dataset.has_file(record):
            absent.append(record.path)
        else:
            _export_photo(
                dataset, record, output, extractor, max_keypoints, descriptors, resolution
            )
        progress("features", done, len(dataset.images))
    return absent


def _export_photo(
    dataset: Dataset,
    record: FileRecord,
    output: Path,
    extractor: LocalFeatureExtractor,
    max_keypoints: int,
    descriptors: Mapping[str, tuple[GlobalDescriptor, Mapping[str, NDArray[np.float32]]]],
    resolution: WorkingResolution,
) -> None:
    """Write the features of one photo, unless they are there."""
    kind, root = extractor.fingerprint.name, output / "reconstruction"
    last_written = [
        root / "descriptors" / kind / f"{record.path}.desc",
        *(root / "global_features" / name / f"{record.path}.gfeat" for name in descriptors),
    ]
    if all(path.is_file() for path in last_written):
        return
    sensor = dataset.sensors[record.sensor_id]
    size = sensor.image_size
    assert size is not None  # every sensor of a photo has one
    photo = read_in_frame(dataset.path_of(record), size, record.sensor_id)
    feature_size = resolution.feature_size(_seen_by(sensor), *size)
    local, rgb = extract_features(
        photo, extractor, max_keypoints=max_keypoints, framing=Framing(feature_size)
    )
    for name, (descriptor, model) in descriptors.items():
        vector = descriptor.describe(rgb, local, model)
        write_global_features(output, name, record.path, vector, name=name)
    keypoints = np.column_stack([local.keypoints, local.scales])
    write_local_features(output, kind, record.path, keypoints, local.descriptors, name=kind)


def _resolution_of(
    dataset: Dataset, extractor: LocalFeatureExtractor, global_from: Map | None
) -> WorkingResolution:
    """How finely the map sees that will be asked; without one, how the photos do."""
    if global_from is not None:
        return MapGeometry(global_from).resolution
    photos = [_seen_by(dataset.sensors[record.sensor_id]) for record in dataset.images]
    return WorkingResolution.of(photos, extractor.fingerprint.parameters)


def _seen_by(sensor: Sensor) -> Resolution:
    if sensor.camera is not None:
        return Resolution.of(sensor.camera)
    size = sensor.image_size
    assert size is not None  # every sensor of a photo has one
    return Resolution(max(size), None)


def _refuse_other_features(
    opened: Map, extractor: LocalFeatureExtractor, max_keypoints: int
) -> None:
    built_with = opened.manifest.local_features
    fingerprint = FingerprintRecord.of(extractor.fingerprint)
    if (built_with.fingerprint, built_with.max_keypoints) != (fingerprint, max_keypoints):
        raise refuse(
            "map.features",
            "the map was built with other local features",
            field="--map",
            expected=f"{fingerprint.name}, at most {max_keypoints} per photo",
            got=f"{built_with.fingerprint.name}, at most {built_with.max_keypoints} per photo",
        )


def _claim(path: Path, settings: Mapping[str, object]) -> None:
    """Note the settings beside the features, so that no other ones join them."""
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    elif path.read_text(encoding="utf-8") != text:
        raise refuse("export.other_settings", field=str(path))


def _write_records(dataset: Dataset, output: Path) -> None:
    """Write the dataset's text files and link its photos, unless an earlier run did."""
    records = output / "sensors" / "records_data"
    photos = (dataset.root / "sensors" / "records_data").resolve()
    if not (records.is_symlink() or records.exists()):
        records.parent.mkdir(parents=True, exist_ok=True)
        records.symlink_to(photos)
    if not (output / "sensors" / "sensors.txt").is_file():
        write_dataset(replace(dataset, root=output))
    if records.resolve() != photos or read_dataset(output).images != dataset.images:
        raise refuse(
            "export.other_dataset",
            field=str(output),
            expected=f"a new folder, or one that was made of {dataset.root}",
        )

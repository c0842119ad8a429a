from __future__ import annotations

from pathlib import Path

import pytest

from mapping.importers import write_imported
from tests.mapping.importers.test_scans import WRITERS, Seen
from visloc.kapture import read_dataset
from visloc_extensions.capture.sources import find_sources, read_capture


@pytest.mark.parametrize("name", WRITERS)
def test_a_capture_takes_scans_with_their_poses_and_depth(
    seen: list[Seen], tmp_path: Path, name: str
) -> None:
    app, write, _ = WRITERS[name]
    scan = tmp_path / "of a phone" / name
    write(scan, seen)
    sources = find_sources([scan])
    assert list(sources.exports.values()) == [(app, scan)]
    assert (sources.videos, sources.folders) == ({}, {})
    for _ in range(2):  # killed, and called again
        model = read_capture(sources, {}, tmp_path / "work", lambda *_: None)
    assert model.metric
    assert all(image.cam_from_world is not None for image in model.images)
    assert all((image.depth is None) == (app == "record3d") for image in model.images)
    write_imported(model, tmp_path / "dataset")
    dataset = read_dataset(tmp_path / "dataset")
    assert all(dataset.has_file(record) for record in (*dataset.images, *dataset.depth_maps))
    assert [path.name for path in scan.parent.iterdir()] == [name]  # nothing was written beside it

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from tests.mapping.pipeline.test_turned_photos import quiet
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.geometry import Pose
from visloc.kapture import read_dataset
from visloc.photos.reading import turn_of
from visloc_extensions.living_maps.updating import UpdateSettings, update_map


def test_a_turned_capture_joins_a_map_of_upright_photos(
    built_maps: Path, turned_sample: Path, orientations: Mapping[str, int], tmp_path: Path
) -> None:
    maps = Path(shutil.copytree(built_maps, tmp_path / "maps"))
    settings = UpdateSettings("room", turned_sample, maps, capture="again")
    done = update_map(settings, quiet)
    opened = MapStore(maps).open("room")

    assert done.record.tied == done.record.photos == 8
    dataset = read_dataset(turned_sample)
    truth = {record.path: dataset.pose(record) for record in dataset.images}
    for image, row in list(zip(opened.images, opened.image_poses, strict=True))[8:]:
        name = image.name.removeprefix("again/")
        assert image.turn == turn_of(orientations[name])
        pose = truth[name]
        assert pose is not None
        assert pose_error(Pose.from_quaternion(row[:4], row[4:]), pose) < (0.01, 0.1)

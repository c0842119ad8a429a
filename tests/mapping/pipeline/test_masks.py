"""A folder of masks: nothing is made of what they hide."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.photos import read_in_frame
from tests.turning import store_photo_turned
from visloc.archive import Map, open_map
from visloc.errors import DatasetError, InvalidInput, TooLarge
from visloc.kapture import read_dataset
from visloc.photos.reading import FILE_LIMITS, read_photo_file, upright, with_mask


def build(dataset: Path, maps: Path, **settings: Any) -> Map:
    values = {"local_features": "sift", "global_features": ("localvlad",), "force": True}
    values |= settings
    return open_map(build_map(BuildSettings(dataset, "room", maps, **values), lambda *_: None))


def write_masks(dataset: Path, folder: Path, *, size: tuple[int, int] = (256, 192)) -> list[str]:
    """Hide the left half of all photos but the last; return the names of those."""
    names = [record.path for record in read_dataset(dataset).images]
    pixels = np.zeros((size[1], size[0]), dtype=np.uint8)
    pixels[:, size[0] // 2 :] = 255
    for name in names[:-1]:
        path = folder / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)
    return names[:-1]


@pytest.mark.parametrize("size", [(256, 192), (128, 96), (512, 384)])
def test_no_landmark_is_seen_where_a_mask_is_black(
    sample: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    masked = write_masks(sample / "mapping", tmp_path / "masks", size=size)

    opened = build(sample / "mapping", tmp_path / "maps", masks=tmp_path / "masks", accept=True)

    rows = {image.name: row for row, image in enumerate(opened.images)}
    for name in masked:
        assert len(opened.keypoints(rows[name])) > 50
        assert opened.keypoints(rows[name])[:, 0].min() >= 128
    (whole,) = rows.keys() - set(masked)
    assert opened.keypoints(rows[whole])[:, 0].min() < 100
    assert any("have no mask and count as a whole" in note for note in opened.manifest.notes)


def test_a_build_with_other_masks_finds_other_features(sample: Path, tmp_path: Path) -> None:
    write_masks(sample / "mapping", tmp_path / "masks")
    with_masks = build(sample / "mapping", tmp_path / "maps", masks=tmp_path / "masks", accept=True)

    without = build(sample / "mapping", tmp_path / "maps")

    assert without.manifest.counts.observations > 1.5 * with_masks.manifest.counts.observations


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mask_is_of_the_pixels_as_stored_or_as_seen(
    sample: Path, tmp_path: Path, orientation: int
) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(next((sample / "query").rglob("*.jpg")).read_bytes())
    store_photo_turned(path, orientation)
    photo = read_photo_file(path)
    mask = np.random.default_rng(0).random((photo.height, photo.width)) > 0.5
    centres = np.argwhere(mask)[:, ::-1] + 0.5
    others = np.argwhere(~mask)[:, ::-1] + 0.5
    for pixels in [mask, *([upright(mask, orientation)] if orientation >= 5 else [])]:
        Image.fromarray(pixels.astype(np.uint8) * 255).save(tmp_path / "mask.png")
        masked = with_mask(photo, (tmp_path / "mask.png").read_bytes())
        assert masked.counts(centres).all()
        assert not masked.counts(others).any()


def test_masks_of_nothing_are_refused(sample: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        build(sample / "mapping", tmp_path / "maps", masks=tmp_path)
    assert (caught.value.code, caught.value.field) == ("masks.none", "--masks")


def test_a_mask_of_another_size_is_refused_by_name(sample: Path, tmp_path: Path) -> None:
    names = write_masks(sample / "mapping", tmp_path / "masks", size=(256, 200))
    with pytest.raises(InvalidInput) as caught:
        build(sample / "mapping", tmp_path / "maps", masks=tmp_path / "masks")
    assert (caught.value.code, caught.value.field) == (
        "mask.size",
        str(tmp_path / "masks" / f"{names[0]}.png"),
    )


def test_a_mask_file_of_any_length_is_not_read_whole(sample: Path, tmp_path: Path) -> None:
    dataset = read_dataset(sample / "mapping")
    mask = tmp_path / "mask.png"
    with mask.open("wb") as file:
        file.truncate(FILE_LIMITS.max_bytes + 2)
    with pytest.raises(TooLarge) as caught:
        read_in_frame(dataset.path_of(dataset.images[0]), (256, 192), "camera", mask)
    assert (caught.value.code, caught.value.field) == ("image.too_large", str(mask))


def test_ready_made_features_take_no_masks(sample: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        build(sample / "mapping", tmp_path, masks=tmp_path, local_features="kapture:d2")
    assert caught.value.code == "masks.ready_made"

"""What format 2.0 stores in fewer bits, and that maps of formats before it mean the same."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import visloc.archive.writer
from tests.fuzz.tiny_map import write_tiny_map
from visloc.archive import (
    Anchor,
    Geodetic,
    GlobalFeatures,
    Map,
    MapContent,
    open_map,
    sha256_of,
    verify_map,
    write_anchored,
)
from visloc.archive import write_map as write_map_to
from visloc.archive.checks import SCALES, content_hash, json_text, manifest_hash, read_model
from visloc.archive.packed import pack_map, unpack_map
from visloc.errors import MapCorrupt
from visloc.geometry import Camera
from visloc.retrieval.index import IndexKind


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_tiny_map(tmp_path / "map")
    return tmp_path / "map"


def content_of(opened: Map) -> MapContent:
    """What a map was written from, as far as it is still known."""
    manifest = opened.manifest
    scale = np.float32(manifest.local_features.descriptor_scale)
    return MapContent(
        metric=True,
        method="rgbd",
        settings={},
        notes=(),
        cameras=opened.cameras,
        rigs={},
        images=opened.images,
        image_poses=opened.image_poses,
        landmarks=visloc.archive.Landmarks(
            origin=np.array(manifest.world.origin),
            points=opened.landmarks,
            track_lengths=opened.track_lengths,
            errors_px=opened.errors_px.astype(np.float32),
            angles_deg=opened.angles_deg.astype(np.float32),
            offsets=opened.observation_offsets,
            observed=opened.observation_landmarks,
            keypoints=np.concatenate([opened.keypoints(i) for i in range(len(opened.images))]),
        ),
        local_fingerprint=manifest.local_features.fingerprint,
        max_keypoints=100,
        descriptor_dim=manifest.local_features.descriptor_dim,
        descriptors=lambda: iter([opened.observation_descriptors.astype(np.float32) * scale]),
        global_features=tuple(
            GlobalFeatures(
                record.fingerprint,
                opened.global_descriptors[record.fingerprint.name][:],
                opened.global_models[record.fingerprint.name],
            )
            for record in manifest.global_features
        ),
    )


def rewritten(opened: Map, target: Path, **changes: object) -> Map:
    target.mkdir()
    content = replace(content_of(opened), **changes)  # type: ignore[arg-type]
    write_map_to(target, content, map_id="room", version="v1", created="2026-01-02T03:04:05+00:00")
    return verify_map(target)


def make_right(folder: Path, manifest: dict[str, object]) -> None:
    """Write a manifest with the checksums of the files that are there."""
    manifest["files"] = {
        path.relative_to(folder).as_posix(): {
            "size": path.stat().st_size,
            "sha256": sha256_of(path),
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "manifest.json"
    }
    manifest["content_hash"] = content_hash(manifest)
    manifest["manifest_hash"] = manifest_hash(manifest)
    (folder / "manifest.json").write_text(json_text(manifest))


def as_before_2_0(opened: Map, folder: Path, version: str) -> None:
    """Store a map as programs before format 2.0 did, in a new folder."""
    shutil.copytree(opened.path, folder)
    keypoints = [opened.keypoints(image) for image in range(len(opened.images))]
    rows = opened.global_descriptors["densevlad"][:]
    np.save(folder / "observation_keypoints.npy", np.concatenate(keypoints))
    np.save(folder / "landmark_error_px.npy", opened.errors_px.astype(np.float32))
    np.save(folder / "landmark_angle_deg.npy", np.full(5, np.nan, np.float32))
    np.save(folder / "global" / "densevlad.npy", rows)
    (folder / "global" / "densevlad.scales.npy").unlink()
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["format_version"] = version
    for name in ("keypoint_step_px", "computed_with"):
        del manifest["local_features"][name]
    for record in manifest["global_features"]:
        del record["bits"], record["lists"]
    make_right(folder, manifest)


@pytest.mark.parametrize("version", ["1.0", "1.1", "1.2", "1.3"])
def test_a_map_of_a_format_before_opens_with_the_same_numbers(
    folder: Path, tmp_path: Path, version: str
) -> None:
    new = open_map(folder)
    expected = [new.keypoints(image) for image in range(len(new.images))]
    rows = new.global_descriptors["densevlad"]
    query = rows[1]
    cosines = rows.cosines(query)
    as_before_2_0(new, tmp_path / "old", version)
    old = verify_map(tmp_path / "old")
    assert old.manifest.format_version == version
    assert old.observation_keypoints.dtype == np.float32
    for image, keypoints in enumerate(expected):
        assert np.array_equal(old.keypoints(image), keypoints)
    assert np.array_equal(old.global_descriptors["densevlad"][:], rows[:])
    np.testing.assert_allclose(old.global_descriptors["densevlad"].cosines(query), cosines, 1e-6)
    assert np.array_equal(old.errors_px, new.errors_px)


@pytest.mark.parametrize(
    ("before", "after"), [("1.0", "1.3"), ("1.3", "1.3"), ("2.0", "2.0"), ("2.7", "2.7")]
)
def test_another_anchor_leaves_a_map_to_the_programs_that_could_read_it(
    folder: Path, tmp_path: Path, before: str, after: str
) -> None:
    if before.startswith("1."):
        as_before_2_0(open_map(folder), tmp_path / "old", before)
        folder = tmp_path / "old"
    else:
        make_right(
            folder,
            json.loads((folder / "manifest.json").read_text()) | {"format_version": before},
        )
    opened = verify_map(folder)
    assert opened.manifest.format_version == before
    place = Geodetic(latitude_deg=1.0, longitude_deg=2.0, altitude_m=3.0, scale=2.0)
    anchor = Anchor(kind="correspondences", images=4, rms=0.1, geodetic=place)
    (tmp_path / "new").mkdir()
    write_anchored(
        opened, tmp_path / "new", anchor, version="v2", created="2026-01-02T03:04:05+00:00"
    )
    found = verify_map(tmp_path / "new")
    assert found.manifest.format_version == after
    assert found.manifest.world.anchor == anchor
    assert found.manifest.files == opened.manifest.files


@pytest.mark.parametrize("version", ["1.3", "3.2"])
def test_packed_maps_of_both_formats_come_back_as_they_were(
    folder: Path, tmp_path: Path, version: str
) -> None:
    if version == "1.3":
        as_before_2_0(open_map(folder), tmp_path / "old", version)
        folder = tmp_path / "old"
    pack_map(folder, tmp_path / "room.zip")
    manifest = unpack_map(tmp_path / "room.zip", tmp_path / "unpacked", 2**20)
    assert manifest.format_version == version
    assert verify_map(tmp_path / "unpacked").manifest == open_map(folder).manifest


def test_keypoints_are_stored_in_small_steps(folder: Path, tmp_path: Path) -> None:
    opened = open_map(folder)
    wanted = np.random.default_rng(0).uniform(-2, 66, (7, 2)).astype(np.float32)
    landmarks = replace(content_of(opened).landmarks, keypoints=wanted)
    written = rewritten(opened, tmp_path / "new", landmarks=landmarks)
    assert written.observation_keypoints.dtype == np.int16
    step = written.manifest.local_features.keypoint_step_px
    assert step is not None
    assert step <= 1 / 256  # of photos of 64 x 48
    found = np.concatenate([written.keypoints(image) for image in range(3)])
    np.testing.assert_allclose(found, wanted, rtol=0, atol=step / 2)


@pytest.mark.parametrize("side", [640, 1600, 4032])
def test_the_step_of_keypoints_follows_the_largest_photo(
    folder: Path, tmp_path: Path, side: int
) -> None:
    camera = Camera("SIMPLE_PINHOLE", 48, side, (50.0, 32.0, 24.0))
    written = rewritten(open_map(folder), tmp_path / "new", cameras={"cam": camera})
    step = written.manifest.local_features.keypoint_step_px
    assert step is not None
    assert side / 30_000 <= step <= side / 15_000


@pytest.mark.parametrize(("side", "keypoint"), [(20_000, 1.0), (64, 200.0), (64, -1e30)])
def test_keypoints_of_huge_photos_or_far_away_are_stored_as_they_are(
    folder: Path, tmp_path: Path, side: int, keypoint: float
) -> None:
    opened = open_map(folder)
    keypoints = np.full((7, 2), keypoint, np.float32)
    camera = Camera("SIMPLE_PINHOLE", side, 48, (50.0, 32.0, 24.0))
    landmarks = replace(content_of(opened).landmarks, keypoints=keypoints)
    written = rewritten(opened, tmp_path / "n", landmarks=landmarks, cameras={"cam": camera})
    assert written.manifest.local_features.keypoint_step_px is None
    assert np.array_equal(written.keypoints(2), keypoints[:4])


def test_errors_beyond_16_bits_are_the_largest_there_is(folder: Path, tmp_path: Path) -> None:
    opened = open_map(folder)
    errors = np.array([0.1, 1e9, np.nan, 2.0, 0.0], np.float32)
    landmarks = replace(content_of(opened).landmarks, errors_px=errors)
    found = rewritten(opened, tmp_path / "new", landmarks=landmarks).errors_px
    np.testing.assert_allclose(found, [0.1, 65504, np.nan, 2.0, 0.0], rtol=1e-3)


def large_model(rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    return {
        "axes": (rng.normal(size=(700, 100)) * np.linspace(0, 3, 100)).astype(np.float32),
        "vocabulary": rng.normal(size=(20, 4)).astype(np.float32),
    }


def test_large_matrices_of_a_model_are_stored_in_8_bits(folder: Path, tmp_path: Path) -> None:
    opened, model = open_map(folder), large_model(np.random.default_rng(0))
    (features,) = content_of(opened).global_features
    written = rewritten(opened, tmp_path / "new", global_features=(replace(features, model=model),))
    found = written.global_models["densevlad"]
    assert sorted(found) == ["axes", "vocabulary"]
    assert np.array_equal(found["vocabulary"], model["vocabulary"])
    steps = np.abs(model["axes"]).max(axis=0) / 127
    assert (np.abs(found["axes"] - model["axes"]) <= steps / 2 + 1e-6).all()
    assert (tmp_path / "new/global/densevlad.model.npz").stat().st_size < 80_000


@pytest.mark.parametrize(
    "scales",
    [
        np.full(100, np.nan, np.float32),
        np.full(100, np.inf, np.float32),
        np.full(100, 3e38, np.float32),
        np.ones(99, np.float32),
        np.ones(100),
        np.ones((1, 100), np.float32),
    ],
)
def test_scales_of_a_model_that_cannot_be_are_refused(
    folder: Path, scales: NDArray[np.generic]
) -> None:
    values = np.full((700, 100), 127, np.int8)
    # The savez stub takes no mapping of arrays as keywords beside allow_pickle.
    arrays: dict[str, Any] = {"axes": values, "axes" + SCALES: scales}
    np.savez(folder / "global" / "densevlad.model.npz", **arrays)
    make_right(folder, json.loads((folder / "manifest.json").read_text()))
    with pytest.raises(MapCorrupt) as caught:
        verify_map(folder)
    assert caught.value.code == "map.array"


def test_scales_of_scales_widen_nothing(folder: Path) -> None:
    arrays: dict[str, Any] = {
        "axes": np.array([[1, 2], [3, 4]], np.int8),
        "axes" + SCALES: np.array([2, 3], np.float32),
        "axes" + 2 * SCALES: np.ones(2, np.float32),
    }
    np.savez(folder / "model.npz", **arrays)
    found = read_model(folder, "model.npz")
    assert found["axes"].tolist() == [[2, 6], [6, 12]]
    arrays["axes" + SCALES] = np.ones((2, 2), np.int8)
    np.savez(folder / "model.npz", **arrays)
    with pytest.raises(MapCorrupt, match="'axes' of a model is not valid"):
        read_model(folder, "model.npz")


def test_what_computed_the_features_is_told(folder: Path, tmp_path: Path) -> None:
    opened = open_map(folder)
    assert opened.manifest.local_features.computed_with is None
    written = rewritten(opened, tmp_path / "new", computed_with="torch 2.13")
    assert written.manifest.local_features.computed_with == "torch 2.13"


@pytest.fixture
def indexed(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A map of three photos, written as one of too many to compare all."""
    monkeypatch.setattr("visloc.archive.writer.MAX_EXACT", 2)
    rewritten(open_map(folder), tmp_path / "indexed")
    return tmp_path / "indexed"


def test_a_map_of_very_many_photos_is_written_with_an_inverted_file(indexed: Path) -> None:
    opened = verify_map(indexed)
    inverted = opened.global_descriptors["densevlad"].inverted
    assert inverted is not None
    assert opened.has_index
    assert len(inverted.centers) == opened.manifest.global_features[0].lists == 3
    query = opened.global_descriptors["densevlad"][1]
    photos, cosines = inverted.rough_cosines(query, np.arange(3))
    assert photos[cosines.argmax()] == 1


@pytest.mark.parametrize(
    ("kind", "has_index"),
    [(IndexKind.AUTO, False), (IndexKind.FLAT, False), (IndexKind.IVF, True)],
)
def test_an_inverted_file_is_written_as_asked_for(
    folder: Path, tmp_path: Path, kind: IndexKind, has_index: bool
) -> None:
    written = rewritten(open_map(folder), tmp_path / "new", index=kind)
    assert written.has_index is has_index
    assert (tmp_path / "new" / "index").exists() is has_index


@pytest.mark.parametrize(
    ("name", "array", "code"),
    [
        ("sizes", np.array([0, 1, 1]), "map.range"),
        ("sizes", np.array([4, 0, -1]), "map.range"),
        ("sizes", np.array([2**63 - 1, 2**63 - 1, 5]), "map.range"),
        ("sizes", np.array([1, 1, 1], np.int32), "map.array"),
        ("sizes", np.array([1, 2]), "map.array"),
        ("centers", np.full((3, 64), np.nan, np.float32), "map.range"),
        ("centers", np.zeros((3, 4), np.float32), "map.array"),
    ],
)
def test_an_inverted_file_that_cannot_be_is_not_opened(
    indexed: Path, name: str, array: NDArray[np.generic], code: str
) -> None:
    np.save(indexed / "index" / f"densevlad.{name}.npy", array)
    make_right(indexed, json.loads((indexed / "manifest.json").read_text()))
    with pytest.raises(MapCorrupt) as caught:
        open_map(indexed)
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("place", "value", "code"),
    [
        (slice(16, 24), np.array([1], "<i8"), "map.range"),  # another row's number
        (slice(16, 24), np.array([3], "<i8"), "map.range"),
        (slice(16, 24), np.array([-1], "<i8"), "map.range"),
        (slice(16, 24), np.array([2**63 - 1], "<i8"), "map.range"),
        (slice(8, 16), np.array([np.nan, 1], "<f4"), "map.range"),
        (slice(24, 96), np.empty(0, "<i8"), "map.array"),
        (slice(0, 0), np.array([0], "<i8"), "map.array"),
    ],
)
def test_lists_that_cannot_be_are_refused(
    indexed: Path, place: slice, value: NDArray[np.generic], code: str
) -> None:
    path = indexed / "index" / "densevlad.lists"
    content = bytearray(path.read_bytes())
    first = int.from_bytes(content[16:24], "little")
    if value.dtype == np.int64 and first == 1 and value.tolist() == [1]:
        value = np.array([0], "<i8")
    content[place] = value.tobytes()
    path.write_bytes(content)
    make_right(indexed, json.loads((indexed / "manifest.json").read_text()))
    with pytest.raises(MapCorrupt) as caught:
        verify_map(indexed)
    assert caught.value.code == code


def test_an_index_of_an_older_format_is_not_used_and_a_warning_says_what_to_do(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Maps of more than 50 000 photos had one in formats 2.0 to 3.0."""
    (folder / "index").mkdir()
    arrays = {
        "centers": np.eye(2, 4, dtype=np.float32),
        "offsets": np.array([0, 1, 3]),
        "members": np.array([2, 0, 1], np.uint32),
    }
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, array in arrays.items():
        np.save(folder / "index" / f"densevlad.{name}.npy", array)
        manifest["files"][f"index/densevlad.{name}.npy"] = {}
    manifest["format_version"] = "2.2"
    manifest["global_features"][0]["clusters"] = 2
    del manifest["global_features"][0]["lists"]
    make_right(folder, manifest)
    opened = verify_map(folder)
    assert not opened.has_index
    assert "compared with all of its 3 photos" in caplog.text
    assert f"mapping upgrade {manifest['id']}" in caplog.text


@pytest.mark.parametrize("scale", [np.nan, -1.0, np.inf])
def test_scales_of_rows_that_cannot_be_are_refused(folder: Path, scale: float) -> None:
    np.save(folder / "global" / "densevlad.scales.npy", np.full(3, scale, np.float32))
    make_right(folder, json.loads((folder / "manifest.json").read_text()))
    with pytest.raises(MapCorrupt) as caught:
        verify_map(folder)
    assert caught.value.code == "map.range"


def test_a_listed_file_of_rows_that_is_missing_is_named(folder: Path) -> None:
    (folder / "global" / "densevlad.scales.npy").unlink()
    make_right(folder, json.loads((folder / "manifest.json").read_text()))
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code == "map.file_missing"


def test_angles_that_nobody_knows_are_not_stored(folder: Path, tmp_path: Path) -> None:
    opened = open_map(folder)
    assert not (folder / "landmark_angle_deg.npy").exists()
    assert opened.angles_deg.shape == (5,)
    assert np.isnan(opened.angles_deg).all()
    angles = np.array([np.nan, 3.0, 179.5, 0.25, np.nan], np.float32)
    landmarks = replace(content_of(opened).landmarks, angles_deg=angles)
    found = rewritten(opened, tmp_path / "new", landmarks=landmarks).angles_deg
    np.testing.assert_allclose(found, angles, rtol=1e-3)

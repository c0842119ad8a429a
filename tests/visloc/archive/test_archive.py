from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from visloc.archive import (
    Anchor,
    FingerprintRecord,
    Geodetic,
    GlobalFeatures,
    ImageRecord,
    Landmarks,
    MapContent,
    MapStore,
    open_map,
    pose_row,
    verify_map,
    write_map,
)
from visloc.errors import Conflict, InvalidInput, MapCorrupt, NotFound
from visloc.geometry import Camera, Pose
from visloc.types import Fingerprint

CREATED = "2026-01-02T03:04:05+00:00"


def make_content(seed: int = 0) -> MapContent:
    """Three photos that see five landmarks seven times."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(7, 8)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return MapContent(
        metric=True,
        method="rgbd",
        settings={"voxel_size": 0.01},
        notes=("one photo has no depth",),
        cameras={"cam": Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))},
        rigs={"rig": {"cam": (0.6, 0.8, 0.0, 0.0, 1.0, 2.0, 3.0)}},
        images=tuple(ImageRecord(name=f"{i}.jpg", camera="cam", timestamp=i) for i in range(3)),
        image_poses=np.array(
            [
                pose_row(Pose.from_quaternion(rng.normal(size=4), rng.normal(size=3)))
                for _ in range(3)
            ]
        ),
        landmarks=Landmarks(
            origin=np.array([500_000.0, 0.0, 10.0]),
            points=rng.normal(size=(5, 3)).astype(np.float32),
            track_lengths=np.array([2, 1, 1, 2, 1], dtype=np.uint16),
            errors_px=np.ones(5, dtype=np.float32),
            angles_deg=np.full(5, np.nan, dtype=np.float32),
            offsets=np.array([0, 3, 3, 7]),
            observed=np.array([0, 1, 3, 0, 2, 3, 4], dtype=np.uint32),
            keypoints=rng.uniform(0, 48, (7, 2)).astype(np.float32),
        ),
        local_fingerprint=FingerprintRecord(name="sift", revision=1, parameters={"max_size": 1600}),
        max_keypoints=100,
        descriptor_dim=8,
        descriptors=lambda: iter([rows[:3], rows[3:3], rows[3:]]),
        global_features=(
            GlobalFeatures(
                FingerprintRecord(name="densevlad", revision=1, parameters={}),
                np.eye(3, 4, dtype=np.float32),
                {"vocabulary": rng.normal(size=(2, 4)).astype(np.float32)},
            ),
        ),
    )


def write(folder: Path, version: str = "v1", seed: int = 0) -> Path:
    folder.mkdir(parents=True)
    write_map(folder, make_content(seed), map_id="room", version=version, created=CREATED)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write(tmp_path / "map")


def test_a_written_map_reads_back_as_it_was(folder: Path) -> None:
    content, opened = make_content(), verify_map(folder)
    assert opened.ref == "room@v1"
    assert opened.images == content.images
    assert opened.cameras == content.cameras
    assert np.array_equal(opened.landmarks, content.landmarks.points)
    assert opened.manifest.world.origin == (500_000.0, 0.0, 10.0)
    low = content.landmarks.points.min(axis=0) + content.landmarks.origin
    assert opened.manifest.world.extent.min == pytest.approx(low)
    assert opened.image_poses.tolist() == content.image_poses.tolist()
    assert opened.rigs["rig"]["cam"].translation.tolist() == [1.0, 2.0, 3.0]
    landmarks, descriptors = opened.observations(2)
    assert landmarks.tolist() == [0, 2, 3, 4]
    assert descriptors.dtype == np.int8
    # eight bits: half a step of the largest value
    assert descriptors * opened.manifest.local_features.descriptor_scale == pytest.approx(
        np.concatenate(list(content.descriptors()))[3:], abs=0.5 / 127
    )
    assert len(opened.observations(1)[0]) == 0


def test_equal_contents_have_equal_hashes_whatever_their_id_version_and_time(
    tmp_path: Path,
) -> None:
    hashes = []
    for map_id, created, seed in (
        ("a", CREATED, 0),
        ("b", "2027-01-01T00:00:00+00:00", 0),
        ("a", CREATED, 1),
    ):
        target = tmp_path / str(len(hashes))
        target.mkdir()
        version = write_map(
            target, make_content(seed), map_id=map_id, version="t-", created=created
        )
        digest = open_map(target).manifest.content_hash
        assert version == f"t-{digest[:8]}"
        hashes.append(digest)
    assert hashes[0] == hashes[1] != hashes[2]


def test_any_flipped_byte_is_found_by_verify_and_refused_when_published(tmp_path: Path) -> None:
    names = [p.relative_to(tmp_path / "0") for p in write(tmp_path / "0").rglob("*") if p.is_file()]
    for number, name in enumerate(names, 1):
        damaged = tmp_path / "incoming" / str(number)
        shutil.copytree(tmp_path / "0", damaged)
        data = bytearray((damaged / name).read_bytes())
        data[len(data) // 2] ^= 0x04
        (damaged / name).write_bytes(data)
        with pytest.raises(MapCorrupt) as caught:
            verify_map(damaged)
        assert caught.value.field
        with pytest.raises(MapCorrupt):
            MapStore(tmp_path / "maps").publish(damaged, "room", "v2")
    assert MapStore(tmp_path / "maps").ids() == []


@pytest.mark.parametrize(
    ("old", "new"), [("2026-01-02", "2026-01-03"), ('"room"', '"moor"'), ("\n ", "\n\t")]
)
def test_any_change_of_the_manifest_is_found_by_verify(folder: Path, old: str, new: str) -> None:
    path = folder / "manifest.json"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(MapCorrupt) as caught:
        verify_map(folder)
    assert caught.value.code == "map.manifest_hash"


def drop_file(folder: Path) -> None:
    (folder / "landmarks.npy").unlink()


def truncate(folder: Path) -> None:
    data = (folder / "landmarks.npy").read_bytes()
    (folder / "landmarks.npy").write_bytes(data[:-1])


def link_out(folder: Path) -> None:
    (folder / "landmarks.npy").rename(folder / "elsewhere.npy")
    (folder / "landmarks.npy").symlink_to("elsewhere.npy")


def edit_manifest(**changes: object) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        manifest = json.loads((folder / "manifest.json").read_text())
        for key, value in changes.items():
            manifest[key] = value
        (folder / "manifest.json").write_text(json.dumps(manifest))

    return edit


def edit_images(folder: Path, turn: object) -> None:
    """Say how the photos were turned, or leave it out."""
    path = folder / "images.json"
    images = json.loads(path.read_text())
    for image in images["images"]:
        image["turn"] = turn
        if turn is None:
            del image["turn"]
    path.write_text(json.dumps(images))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["images.json"]["size"] = path.stat().st_size
    (folder / "manifest.json").write_text(json.dumps(manifest))


def escape(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["../../etc/passwd"] = manifest["files"]["landmarks.npy"]
    (folder / "manifest.json").write_text(json.dumps(manifest))


def replace_array(name: str, array: np.ndarray) -> Callable[[Path], None]:
    """Swap a file for another of the same size, as an attacker would, manifest included."""

    def swap(folder: Path) -> None:
        np.save(folder / name, array)
        manifest = json.loads((folder / "manifest.json").read_text())
        manifest["files"][name]["size"] = (folder / name).stat().st_size
        (folder / "manifest.json").write_text(json.dumps(manifest))

    return swap


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (drop_file, "map.file_missing"),
        (truncate, "map.file_size"),
        (link_out, "map.file_missing"),
        (escape, "map.file_name"),
        (lambda f: (f / "manifest.json").unlink(), "map.manifest"),
        (lambda f: (f / "manifest.json").write_text("{"), "map.manifest"),
        (lambda f: (f / "manifest.json").write_text("[]"), "map.manifest"),
        (lambda f: (f / "manifest.json").write_bytes(b"\xff\xfe"), "map.manifest"),
        (edit_manifest(format_version="4.0"), "map.format_version"),
        (edit_manifest(format_version="9" * 9 + ".0"), "map.manifest"),
        (edit_manifest(format="zip"), "map.manifest"),
        (edit_manifest(files={}), "map.file_missing"),
        (edit_manifest(counts={"images": 3, "landmarks": 6, "observations": 7}), "map.array"),
        (edit_manifest(counts={"images": 2, "landmarks": 5, "observations": 7}), "map.images"),
        (replace_array("landmarks.npy", np.zeros((5, 3))), "map.array"),
        (replace_array("landmarks.npy", np.zeros((1, 3), np.float32)), "map.array"),
    ],
)
def test_a_damaged_map_is_refused_at_opening_with_the_reason(
    folder: Path, damage: Callable[[Path], None], code: str
) -> None:
    damage(folder)
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code == code
    assert caught.value.field


def test_a_newer_minor_format_with_unknown_fields_opens(folder: Path) -> None:
    edit_manifest(format_version="3.9", colours="yes")(folder)
    assert open_map(folder).manifest.format_version == "3.9"


@pytest.mark.parametrize("turn", [None, 6])
def test_photos_of_formats_before_2_2_were_not_turned(folder: Path, turn: int | None) -> None:
    edit_images(folder, turn)
    assert [image.turn for image in open_map(folder).images] == [turn or 1] * 3


@pytest.mark.parametrize("turn", [0, 9, "6h"])
def test_a_turn_that_is_none_is_refused(folder: Path, turn: object) -> None:
    edit_images(folder, turn)
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code == "map.json"


def test_programs_that_know_formats_1_call_this_one_newer(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("visloc.archive.checks.FORMAT_MAJOR", 1)
    with pytest.raises(MapCorrupt, match="newer visloc wrote the map; upgrade") as caught:
        open_map(folder)
    assert (caught.value.code, caught.value.got) == ("map.format_version", "3.2")


@pytest.mark.parametrize(
    "offsets",
    [
        [0, 4, 3, 7],
        [1, 3, 3, 7],
        [0, 3, 3, 6],
        [0, -1, 3, 7],
        [0, 2**63 - 1, -(2**63), 7],  # differences of these wrap around to 1 and 7
    ],
)
def test_offsets_that_do_not_lead_through_the_rows_are_refused(
    folder: Path, offsets: list[int]
) -> None:
    content = make_content()
    content.landmarks.offsets[:] = offsets
    target = folder.parent / "lying"
    target.mkdir()
    write_map(target, content, map_id="room", version="v1", created=CREATED)
    with pytest.raises(MapCorrupt, match="observation_offsets"):
        verify_map(target)


def test_numbers_that_lie_are_found_even_when_checksums_agree(tmp_path: Path) -> None:
    content = make_content()
    content.landmarks.observed[2] = 99
    target = tmp_path / "lying"
    target.mkdir()
    write_map(target, content, map_id="room", version="v1", created=CREATED)
    with pytest.raises(MapCorrupt, match="observation_landmarks"):
        verify_map(target)


COLORS = np.arange(15, dtype=np.uint8).reshape(5, 3)
ANCHOR = Anchor(
    kind="gnss",
    images=3,
    rms=0.25,
    geodetic=Geodetic(latitude_deg=45.2, longitude_deg=5.7, altitude_m=212.5),
)


def make_ready_made_content() -> MapContent:
    """A map of ready-made features, with colours and an anchor; nothing sees landmark 3."""
    content = make_content()
    lonely = np.where(content.landmarks.observed == 3, 0, content.landmarks.observed)
    (densevlad,) = content.global_features
    name = "kapture:AP-GeM-LM18"
    return replace(
        content,
        local_fingerprint=FingerprintRecord.of(Fingerprint("kapture:D2-Net", 1, {"dsize": 8})),
        landmarks=replace(
            content.landmarks,
            colors=COLORS,
            observed=lonely.astype(np.uint32),
            track_lengths=np.array([2, 1, 1, 0, 1], dtype=np.uint16),
        ),
        global_features=(
            GlobalFeatures(
                FingerprintRecord(name=name, revision=1, parameters={"metric_type": "l2"}),
                np.eye(3, 5, dtype=np.float32),
                {},
            ),
            densevlad,
        ),
        anchor=ANCHOR,
    )


def write_content(folder: Path, content: MapContent) -> Path:
    folder.mkdir(parents=True)
    write_map(folder, content, map_id="room", version="v1", created=CREATED)
    return folder


def test_a_map_of_ready_made_features_with_colours_and_anchor_reads_back(tmp_path: Path) -> None:
    folder = write_content(tmp_path / "incoming", make_ready_made_content())
    MapStore(tmp_path / "maps").publish(folder, "room", "v1")
    opened = MapStore(tmp_path / "maps").open("room")
    assert opened.manifest.format_version == "3.2"
    assert opened.manifest.world.anchor == ANCHOR
    assert opened.manifest.local_features.fingerprint.name == "kapture:D2-Net"
    assert opened.colors is not None
    assert opened.colors.dtype == np.uint8
    assert np.array_equal(opened.colors, COLORS)
    assert opened.track_lengths.tolist() == [2, 1, 1, 0, 1]
    assert list(opened.global_descriptors) == ["kapture:AP-GeM-LM18", "densevlad"]
    rows = opened.global_descriptors["kapture:AP-GeM-LM18"][:]
    np.testing.assert_allclose(rows, np.eye(3, 5), atol=1e-7)
    assert opened.global_models["kapture:AP-GeM-LM18"] == {}
    assert sorted(path.name for path in (opened.path / "global").iterdir()) == [
        "densevlad.model.npz",
        "densevlad.npy",
        "densevlad.scales.npy",
        "kapture-AP-GeM-LM18.model.npz",
        "kapture-AP-GeM-LM18.npy",
        "kapture-AP-GeM-LM18.scales.npy",
    ]


def test_a_map_without_colours_and_anchor_says_so(folder: Path) -> None:
    opened = verify_map(folder)
    assert opened.colors is None
    assert opened.manifest.world.anchor is None
    assert "anchor" not in json.loads((folder / "manifest.json").read_text())["world"]


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_a_map_of_an_older_format_opens(folder: Path, version: str) -> None:
    edit_manifest(format_version=version)(folder)
    opened = open_map(folder)
    assert opened.manifest.format_version == version
    assert opened.gravity is None


def test_gravity_reads_back_as_it_was(tmp_path: Path) -> None:
    content = replace(make_content(), gravity=(0.6, 0.0, -0.8))
    opened = verify_map(write_content(tmp_path / "map", content))
    assert opened.gravity is not None
    assert opened.gravity.tolist() == [0.6, 0.0, -0.8]
    assert opened.manifest.world.gravity == (0.6, 0.0, -0.8)


def test_a_map_without_gravity_says_so(folder: Path) -> None:
    opened = verify_map(folder)
    assert opened.gravity is None
    assert "gravity" not in json.loads((folder / "manifest.json").read_text())["world"]


@pytest.mark.parametrize(("geodetic", "down"), [(ANCHOR.geodetic, [0, 0, -1]), (None, None)])
def test_a_geodetic_anchor_tells_what_is_down(
    tmp_path: Path, geodetic: Geodetic | None, down: list[float] | None
) -> None:
    anchor = ANCHOR.model_copy(update={"geodetic": geodetic})
    folder = write_content(tmp_path / "map", replace(make_content(), anchor=anchor))
    edit_manifest(format_version="1.1")(folder)
    opened = open_map(folder)
    assert opened.manifest.world.gravity is None
    assert (None if opened.gravity is None else opened.gravity.tolist()) == down


@pytest.mark.parametrize(
    "gravity",
    [[0, 0, 0], [0, 0, -2], [0, 0, -1.00001], [0, -1], [0, 0, "down"], [1e308, 1e308, 0], 1],
)
def test_a_gravity_that_cannot_be_is_refused(folder: Path, gravity: object) -> None:
    world = json.loads((folder / "manifest.json").read_text())["world"]
    edit_manifest(world={**world, "gravity": gravity})(folder)
    with pytest.raises(MapCorrupt, match=r"world\.gravity") as caught:
        open_map(folder)
    assert caught.value.code == "map.manifest"


@pytest.mark.parametrize(
    "anchor",
    [
        {"kind": "guess", "images": 1},
        {"kind": "gnss", "images": -1},
        {"kind": "gnss", "images": 1, "rms": -1.0},
        {"kind": "gnss", "images": 1, "geodetic": {"latitude_deg": 91}},
        {
            "kind": "gnss",
            "images": 1,
            "geodetic": {"latitude_deg": 91, "longitude_deg": 0, "altitude_m": 0},
        },
    ],
)
def test_an_anchor_that_cannot_be_is_refused(folder: Path, anchor: dict[str, object]) -> None:
    world = json.loads((folder / "manifest.json").read_text())["world"]
    edit_manifest(world={**world, "anchor": anchor})(folder)
    with pytest.raises(MapCorrupt, match=r"world\.anchor") as caught:
        open_map(folder)
    assert caught.value.code == "map.manifest"


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (replace_array("landmark_rgb.npy", COLORS[:4]), "map.array"),
        (replace_array("landmark_rgb.npy", COLORS.astype(np.float32)), "map.array"),
        (lambda f: (f / "landmark_rgb.npy").unlink(), "map.file_missing"),
    ],
)
def test_damaged_colours_are_refused(
    tmp_path: Path, damage: Callable[[Path], None], code: str
) -> None:
    folder = write_content(tmp_path / "map", make_ready_made_content())
    damage(folder)
    with pytest.raises(MapCorrupt, match="landmark_rgb") as caught:
        open_map(folder)
    assert caught.value.code == code


@pytest.mark.parametrize(
    "name",
    ["kapture:", "kapture:../a", "kapture:a/b", "kapture:.a", "Kapture:a", "a:b", "SIFT", "a\n",
     "kapture:a\n", "kapture:" + "a" * 65],
)  # fmt: skip
def test_names_that_are_no_features_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="name"):
        FingerprintRecord(name=name, revision=1, parameters={})


def test_two_global_descriptors_of_one_file_are_refused(tmp_path: Path) -> None:
    folder = write_content(tmp_path / "map", make_ready_made_content())
    features = json.loads((folder / "manifest.json").read_text())["global_features"]
    features[1]["fingerprint"]["name"] = "kapture-AP-GeM-LM18".lower()
    features[0]["fingerprint"]["name"] = "kapture:ap-gem-lm18"
    edit_manifest(global_features=features)(folder)
    with pytest.raises(MapCorrupt, match="two global descriptors") as caught:
        open_map(folder)
    assert caught.value.code == "map.manifest"


def test_publishing_switches_current_and_keeps_the_older_version(tmp_path: Path) -> None:
    store = MapStore(tmp_path / "maps")
    for number, version in enumerate(["v1", "v2"]):
        store.publish(write(tmp_path / version, version, seed=number), "room", version)
    assert store.ids() == ["room"]
    assert store.versions("room") == ["v1", "v2"]
    assert store.open("room").ref == "room@v2"
    assert store.open("room@v1").ref == "room@v1"
    with pytest.raises(Conflict):
        store.publish(write(tmp_path / "again", "v2"), "room", "v2")
    assert store.open("room").ref == "room@v2"


@pytest.mark.parametrize(
    "ref", ["../room", "room/..", "", "room@../v1", ".hidden", "a" * 65, "ro\0om"]
)
def test_a_reference_that_is_a_path_is_refused(tmp_path: Path, ref: str) -> None:
    store = MapStore(tmp_path / "maps")
    store.publish(write(tmp_path / "one"), "room", "v1")
    with pytest.raises(InvalidInput) as caught:
        store.folder(ref)
    assert caught.value.code == "map.id"


def test_an_unknown_map_or_version_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    store = MapStore(tmp_path / "maps")
    with pytest.raises(NotFound, match="none"):
        store.folder("room")
    store.publish(write(tmp_path / "one"), "room", "v1")
    with pytest.raises(NotFound, match="room"):
        store.folder("kitchen")
    with pytest.raises(NotFound, match="v1"):
        store.folder("room@v9")
    with pytest.raises(NotFound):
        store.folder("kitchen@v1")


def test_a_damaged_current_file_is_named(tmp_path: Path) -> None:
    store = MapStore(tmp_path / "maps")
    store.publish(write(tmp_path / "one"), "room", "v1")
    (tmp_path / "maps" / "room" / "current").write_text("../../etc\n")
    with pytest.raises(MapCorrupt, match="current"):
        store.open("room")

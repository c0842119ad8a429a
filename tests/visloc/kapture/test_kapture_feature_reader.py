from __future__ import annotations

import io
import os
import pickle
import tarfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visloc.errors import DatasetError, InvalidInput
from visloc.kapture import (
    FeatureKind,
    feature_types,
    open_features,
    open_local_features,
    write_global_features,
    write_local_features,
)
from visloc.kapture.feature_layout import DTYPES, SUFFIXES, parse_dtype

ROWS = np.arange(12, dtype=np.float32).reshape(4, 3)


def make_folder(root: Path, line: str, kind: FeatureKind = "keypoints", where: str = "") -> Path:
    """A folder of features of type ``t`` with one line of description."""
    folder = root / (where or f"reconstruction/{kind}/t")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{kind}.txt").write_text(f"# kapture format: 1.1\n# columns\n{line}\n")
    return folder


def make_tar(path: Path, *members: tuple[str, bytes]) -> None:
    with tarfile.open(path, "w:") as archive:
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


@settings(max_examples=50, deadline=None)
@given(
    name=st.sampled_from(sorted(DTYPES)),
    shape=st.tuples(st.integers(0, 5), st.integers(2, 7)),
    seed=st.integers(0, 9),
)
def test_what_was_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, name: str, shape: tuple[int, int], seed: int
) -> None:
    root = tmp_path_factory.mktemp("dataset")
    rng = np.random.default_rng(seed)
    keypoints = rng.uniform(0, 99, shape).astype(np.float32)
    descriptors = rng.integers(0, 256, shape).astype(DTYPES[name])
    write_local_features(root, "t", "a/b.jpg", keypoints, descriptors, name="n")
    write_global_features(root, "g", "a/b.jpg", ROWS[0], name="n")
    read_keypoints, read_descriptors = open_local_features(root, "t")
    for features, rows in ((read_keypoints, keypoints), (read_descriptors, descriptors)):
        back = features.read("a/b.jpg")
        assert back.dtype == rows.dtype
        assert back.shape == rows.shape
        assert np.array_equal(back, rows)
        assert features.count("a/b.jpg") == len(rows)
    assert open_features(root, "global_features", "g").read("a/b.jpg").tolist() == [[0, 1, 2]]


def test_a_feature_set_says_what_its_file_says(tmp_path: Path) -> None:
    make_folder(tmp_path, "r2d2, np.float32, 128, r2d2_500, L2", "descriptors")
    features = open_features(tmp_path, "descriptors", "t")
    assert (features.kind, features.type_name, features.name) == ("descriptors", "t", "r2d2")
    assert (features.dtype, features.dsize) == (np.dtype("<f4"), 128)
    assert (features.keypoints_type, features.metric_type) == ("r2d2_500", "L2")
    make_folder(tmp_path, "dirtorch, float64, 2048, cosine", "global_features")
    features = open_features(tmp_path, "global_features", "t")
    assert (features.keypoints_type, features.metric_type) == (None, "cosine")
    make_folder(tmp_path, "sift, float, 4")
    features = open_features(tmp_path, "keypoints", "t")
    assert (features.dtype, features.dsize) == (np.dtype("<f8"), 4)
    assert (features.keypoints_type, features.metric_type) == (None, None)


@pytest.mark.parametrize(
    ("text", "dtype"),
    [("float", "<f8"), ("np.float32", "<f4"), ("numpy.uint8", "u1"), ("int32", "<i4")],
)
def test_spellings_of_types_are_looked_up(text: str, dtype: str) -> None:
    assert parse_dtype(text) == np.dtype(dtype)


@given(st.text(max_size=40))
def test_nothing_but_known_types_is_a_type(text: str) -> None:
    assert parse_dtype(text) is None or text in {
        prefix + name for prefix in ("", "np.", "numpy.") for name in (*DTYPES, "float")
    }


@pytest.mark.parametrize(
    ("kind", "line", "code"),
    [
        ("keypoints", "n, __import__('os').abort(), 3", "kapture.dtype"),
        ("keypoints", "n, object, 3", "kapture.dtype"),
        ("keypoints", "n, float16, 3", "kapture.dtype"),
        ("keypoints", "n, >f4, 3", "kapture.dtype"),
        ("keypoints", "n, float32, 1", "kapture.dsize"),
        ("keypoints", "n, float32, 0", "kapture.dsize"),
        ("keypoints", "n, float32, -3", "kapture.dsize"),
        ("keypoints", "n, float32, 3.0", "kapture.dsize"),
        ("keypoints", "n, float32, ٣", "kapture.dsize"),
        ("keypoints", "n, float32, 9999999", "kapture.dsize"),
        ("keypoints", "n, float32, " + "9" * 5000, "kapture.dsize"),
        ("keypoints", "n, float32", "kapture.column_count"),
        ("keypoints", "", "kapture.feature_config"),
        ("keypoints", "n, float32, 3\nn, float32, 3", "kapture.feature_config"),
        ("descriptors", "n, float32, 3", "kapture.column_count"),
        ("global_features", "n, float32, 3", "kapture.column_count"),
    ],
)
def test_a_description_that_cannot_be_is_refused_with_its_line(
    tmp_path: Path, kind: FeatureKind, line: str, code: str
) -> None:
    path = make_folder(tmp_path, line, kind) / f"{kind}.txt"
    with pytest.raises(DatasetError) as caught:
        open_features(tmp_path, kind, "t")
    assert caught.value.code == code
    assert caught.value.field is not None
    assert caught.value.field.startswith(f"{path}:")


def test_missing_images_are_told_apart_from_empty_ones(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, "n, float32, 3")
    (folder / "a.jpg.kpt").write_bytes(b"")
    (folder / "folder.jpg.kpt").mkdir()
    os.mkfifo(folder / "pipe.jpg.kpt")
    features = open_features(tmp_path, "keypoints", "t")
    assert features.has("a.jpg")
    assert features.read("./a.jpg").shape == (0, 3)
    for name in ("b.jpg", "folder.jpg", "pipe.jpg", "a.jpg.kpt/c.jpg"):
        assert not features.has(name)
        for read in (features.read, features.count):
            with pytest.raises(DatasetError) as caught:
                read(name)
            assert caught.value.code == "kapture.feature_missing"
            assert caught.value.field == str(folder / f"{name}.kpt")


@pytest.mark.parametrize("size", [1, 11, 13])
def test_a_size_that_is_no_whole_rows_is_refused(tmp_path: Path, size: int) -> None:
    folder = make_folder(tmp_path, "n, float32, 3")
    (folder / "a.jpg.kpt").write_bytes(bytes(size))
    with pytest.raises(DatasetError, match=r"keypoints\.txt") as caught:
        open_features(tmp_path, "keypoints", "t").read("a.jpg")
    assert caught.value.code == "kapture.feature_size"
    assert caught.value.field == str(folder / "a.jpg.kpt")


@pytest.mark.parametrize("num_rows", [0, 2])
def test_an_image_has_exactly_one_global_feature(tmp_path: Path, num_rows: int) -> None:
    folder = make_folder(tmp_path, "n, float32, 3, L2", "global_features")
    (folder / "a.jpg.gfeat").write_bytes(bytes(12 * num_rows))
    with pytest.raises(DatasetError) as caught:
        open_features(tmp_path, "global_features", "t").read("a.jpg")
    assert caught.value.code == "kapture.feature_size"


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, "n, float32, 4")
    with (folder / "a.jpg.kpt").open("wb") as file:
        file.truncate(2**40)  # sparse: takes no space
    with pytest.raises(DatasetError) as caught:
        open_features(tmp_path, "keypoints", "t").read("a.jpg")
    assert caught.value.code == "kapture.feature_too_large"


@pytest.mark.parametrize("path", ["../a.jpg", "/a.jpg", "", "a/../../b.jpg", "..\\a.jpg", "a\0"])
def test_no_path_leads_out(tmp_path: Path, path: str) -> None:
    make_folder(tmp_path, "n, float32, 3")
    features = open_features(tmp_path, "keypoints", "t")
    for use in (features.has, features.count, features.read):
        with pytest.raises(DatasetError) as caught:
            use(path)
        assert caught.value.code == "kapture.path"


@pytest.mark.parametrize("name", ["..", ".hidden", "a/b", "", "a b", "a" * 65, "{}", "t\n"])
def test_a_type_that_is_no_folder_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        open_features(tmp_path, "keypoints", name)
    assert caught.value.code == "kapture.feature_type"


@pytest.mark.parametrize(
    ("kind", "where"),
    [
        ("keypoints", "local_features/t/keypoints"),
        ("descriptors", "local_features/t/descriptors"),
        ("global_features", "global_features/t/global_features"),
        ("keypoints", "t/keypoints"),
        ("global_features", "t/global_features"),
        ("keypoints", "reconstruction/keypoints/t"),
        ("descriptors", "descriptors/t"),
        ("global_features", "global_features/t"),
    ],
)
def test_features_outside_the_dataset_are_found(
    tmp_path: Path, kind: FeatureKind, where: str
) -> None:
    line = {
        "keypoints": "n, float32, 3",
        "descriptors": "n, float32, 3, t, L2",
        "global_features": "n, float32, 3, L2",
    }[kind]
    folder = make_folder(tmp_path / "outside", line, kind, where)
    (folder / f"a.jpg{SUFFIXES[kind]}").write_bytes(ROWS[:1].tobytes())
    features = open_features(tmp_path / "dataset", kind, "t", tmp_path / "outside")
    assert features.folder == folder
    assert features.read("a.jpg").tolist() == [[0, 1, 2]]
    assert feature_types(tmp_path / "dataset", kind, tmp_path / "outside") == ("t",)
    assert feature_types(tmp_path / "dataset", kind) == ()


def test_an_unknown_type_is_answered_with_places_and_known_types(tmp_path: Path) -> None:
    for name in ("sift", "r2d2_500"):
        make_folder(tmp_path, "n, float32, 3", where=f"local_features/{name}/keypoints")
    with pytest.raises(DatasetError) as caught:
        open_features(tmp_path / "dataset", "keypoints", "d2net", tmp_path)
    assert caught.value.code == "kapture.no_features"
    assert caught.value.field == str(tmp_path)
    for words in ("local_features/d2net/keypoints", "d2net/keypoints", "r2d2_500, sift"):
        assert words in str(caught.value)
    with pytest.raises(DatasetError, match="types there: none"):
        open_features(tmp_path / "dataset", "keypoints", "d2net")


def test_the_layout_of_kapture_1_0_is_named(tmp_path: Path) -> None:
    make_folder(tmp_path, "n, float32, 3", where="reconstruction/keypoints")
    with pytest.raises(DatasetError, match=r"kapture 1\.0.*keypoints/t") as caught:
        open_features(tmp_path, "keypoints", "t")
    assert caught.value.code == "kapture.version"


def test_descriptors_name_their_keypoints(tmp_path: Path) -> None:
    make_folder(tmp_path, "HOG, uint8, 4, Hessian, L2", "descriptors")
    make_folder(tmp_path, "n, float32, 4", where="reconstruction/keypoints/Hessian")
    keypoints, descriptors = open_local_features(tmp_path, "t")
    assert (keypoints.type_name, descriptors.type_name) == ("Hessian", "t")
    make_folder(tmp_path, "HOG, uint8, 4, ../../etc, L2", "descriptors")
    with pytest.raises(InvalidInput) as caught:
        open_local_features(tmp_path, "t")
    assert caught.value.code == "kapture.feature_type"


def test_an_archive_is_read_in_place_and_its_last_member_wins(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, "n, float32, 3")
    (folder / "loose.jpg.kpt").write_bytes(ROWS.tobytes())
    make_tar(
        folder / "keypoints.tar",
        ("a.jpg.kpt", bytes(12)),
        ("./m/b.jpg.kpt", ROWS.tobytes()),
        ("a.jpg.kpt", ROWS[:2].tobytes()),
        ("empty.jpg.kpt", b""),
        ("../../escape.jpg.kpt", ROWS.tobytes()),
        ("/rooted.jpg.kpt", ROWS.tobytes()),
        ("odd.jpg.kpt", b"odd"),
    )
    with tarfile.open(folder / "keypoints.tar", "a:") as archive:
        for name, kind in (("link.jpg.kpt", tarfile.SYMTYPE), ("hard.jpg.kpt", tarfile.LNKTYPE)):
            info = tarfile.TarInfo(name)
            info.type, info.linkname = kind, "a.jpg.kpt"
            archive.addfile(info)
        info = tarfile.TarInfo("dir.jpg.kpt")
        info.type = tarfile.DIRTYPE
        archive.addfile(info)
    before = sorted(tmp_path.rglob("*"))
    features = pickle.loads(pickle.dumps(open_features(tmp_path, "keypoints", "t")))
    assert np.array_equal(features.read("a.jpg"), ROWS[:2])
    assert np.array_equal(features.read("m/b.jpg"), ROWS)
    assert features.read("empty.jpg").shape == (0, 3)
    for name in ("loose", "link", "hard", "dir", "escape", "rooted"):
        assert not features.has(f"{name}.jpg")
    with pytest.raises(DatasetError, match=r"keypoints\.tar") as caught:
        features.read("odd.jpg")
    assert caught.value.code == "kapture.feature_size"
    with pytest.raises(DatasetError, match=r"keypoints\.tar"):
        features.read("loose.jpg")
    assert sorted(tmp_path.rglob("*")) == before


def cut_data(content: bytes) -> bytes:
    return content[:600]


def cut_header(content: bytes) -> bytes:
    return content[: 1536 + 100]


def break_header(content: bytes) -> bytes:
    return content[:1540] + b"?" * 100 + content[1640:]


def negative_size(content: bytes) -> bytes:
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        info = archive.getmembers()[-1]
    header = bytearray(content[info.offset : info.offset + 512])
    header[124:136] = b"\xff" * 10 + (2**16 - 1536).to_bytes(2, "big")  # -1536 in base 256
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return content[: info.offset] + bytes(header) + content[info.offset + 512 :]


def compress(content: bytes) -> bytes:
    import gzip

    return gzip.compress(content)


@pytest.mark.parametrize(
    "damage",
    [cut_data, cut_header, break_header, negative_size, compress, lambda _: b"?" * 2000],
)
def test_a_damaged_archive_is_refused(tmp_path: Path, damage: object) -> None:
    folder = make_folder(tmp_path, "n, float32, 3")
    path = folder / "keypoints.tar"
    make_tar(path, ("a.jpg.kpt", bytes(516)), ("b.jpg.kpt", bytes(12)), ("c.jpg.kpt", bytes(12)))
    assert callable(damage)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DatasetError) as caught:
        open_features(tmp_path, "keypoints", "t")
    assert caught.value.code == "kapture.tar"
    assert caught.value.field == str(path)


def test_an_archive_without_its_end_is_complete(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, "n, float32, 3")
    path = folder / "keypoints.tar"
    make_tar(path, ("a.jpg.kpt", ROWS.tobytes()))
    path.write_bytes(path.read_bytes()[:1024])  # as an interrupted append leaves it
    assert open_features(tmp_path, "keypoints", "t").read("a.jpg").shape == (4, 3)


def test_published_features_outside_their_dataset_are_read(shared_data: Path) -> None:
    root = shared_data / "virtual_gallery"
    keypoints, descriptors = open_local_features(root / "mapping", "r2d2_500", root)
    image = "training/gallery_light1_loop1/frames/rgb/camera_0/rgb_00223.jpg"
    assert keypoints.read(image).shape == (500, 3)
    assert descriptors.read(image).shape == (500, 128)
    vectors = open_features(root / "mapping", "global_features", "AP-GeM-LM18", root)
    assert vectors.name == "dirtorch"
    assert np.linalg.norm(vectors.read(image)) == pytest.approx(1, abs=1e-3)


def test_a_tar_that_is_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    folder = make_folder(tmp_path, "n, float32, 3")
    os.mkfifo(folder / "keypoints.tar")
    with pytest.raises(DatasetError) as caught:
        open_features(tmp_path, "keypoints", "t")
    assert caught.value.code == "kapture.tar"

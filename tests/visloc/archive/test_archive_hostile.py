"""What fuzzing found, or was made to look for, in maps on disk."""

from __future__ import annotations

import io
import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.tiny_map import write_tiny_map
from visloc.archive import open_map, sha256_of, verify_map
from visloc.archive.checks import content_hash, json_text, manifest_hash
from visloc.errors import MapCorrupt


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_tiny_map(tmp_path / "map")
    return tmp_path / "map"


def make_right(folder: Path, name: str) -> None:
    """Make the manifest that of an altered file."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["files"][name]["size"] = (folder / name).stat().st_size
    manifest["files"][name]["sha256"] = sha256_of(folder / name)
    manifest["content_hash"] = content_hash(manifest)
    manifest["manifest_hash"] = manifest_hash(manifest)
    path.write_text(json_text(manifest))


def refusal(folder: Path) -> str:
    with pytest.raises(MapCorrupt) as caught:
        verify_map(folder)
    return caught.value.code


@pytest.mark.parametrize("kind", ["folder", "pipe", "link", "link to a device"])
def test_a_manifest_that_is_no_plain_file_is_refused_and_not_waited_for(
    folder: Path, kind: str
) -> None:
    manifest = folder / "manifest.json"
    manifest.rename(folder / "elsewhere.json")
    if kind == "folder":
        manifest.mkdir()
    elif kind == "pipe":
        os.mkfifo(manifest)
    else:
        manifest.symlink_to("/dev/zero" if "device" in kind else folder / "elsewhere.json")
    assert refusal(folder) == "map.manifest"


def test_a_rotation_whose_length_overflows_is_out_of_range_without_a_warning(folder: Path) -> None:
    poses = np.load(folder / "image_poses.npy")
    poses[0, 0] = 1e300
    np.save(folder / "image_poses.npy", poses)
    make_right(folder, "image_poses.npy")
    assert refusal(folder) == "map.range"


_RECEIVER = '"receivers": {"gps": ["EPSG:4326"]}'
_FIX = '{"timestamp": 1, "receiver": "gps", "x": 8, "y": 48, "z": 4, "utc": 0, "dop": %s}'


@pytest.mark.parametrize(
    "text",
    [
        "{",
        f'{{{_RECEIVER}, "fixes": [{_FIX % "NaN"}]}}',
        f'{{"receivers": {{}}, "fixes": [{_FIX % 1}]}}',
        f'{{{_RECEIVER}, "fixes": [{_FIX % 1}, {_FIX % 2}]}}',
        f'{{{_RECEIVER}, "fixes": [{_FIX.replace("1", str(2**63)) % 1}]}}',
    ],
)
def test_fixes_that_no_receiver_gave_are_found_though_no_query_reads_them(
    folder: Path, text: str
) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["gnss.json"] = {}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "gnss.json").write_text(f'{{{_RECEIVER}, "fixes": [{_FIX % 1}]}}')
    make_right(folder, "gnss.json")
    verify_map(folder)
    (folder / "gnss.json").write_text(text)
    make_right(folder, "gnss.json")
    assert refusal(folder) == "map.json"


@pytest.mark.parametrize("name", ["a" * 300, "a\0b", "\ud800", "images.json/x", "x" * 5000])
def test_a_listed_name_that_no_file_can_have_is_refused(folder: Path, name: str) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"][name] = {"size": 1, "sha256": "0" * 64}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code in ("map.file_missing", "map.file_name", "map.manifest")


def a_zip() -> bytes:
    file = io.BytesIO()
    np.savez(file, a=np.zeros(3))
    return file.getvalue()


def with_header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize("name", ["image_poses.npy", "landmarks.npy"])  # read, and mapped
@pytest.mark.parametrize(
    "content",
    [
        a_zip(),
        b"",
        with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (3, 7"),
        with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000, 7)}"),
        with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (-3, -7)}"),
        with_header("(" * 5000),
        pickle.dumps([1.0]),
    ],
    ids=["zip", "nothing", "cut", "huge", "negative", "deep", "pickle"],
)
def test_an_array_that_is_none_or_lies_about_its_shape_is_refused(
    folder: Path, name: str, content: bytes
) -> None:
    (folder / name).write_bytes(content)
    make_right(folder, name)
    assert refusal(folder) == "map.array"


@pytest.mark.parametrize("name", ["image_poses.npy", "landmarks.npy"])
def test_an_array_in_fortrans_order_means_the_same(folder: Path, name: str) -> None:
    array = np.load(folder / name)
    np.save(folder / name, np.asfortranarray(array))
    make_right(folder, name)
    opened = verify_map(folder)
    np.testing.assert_array_equal(
        opened.image_poses if name == "image_poses.npy" else opened.landmarks, array
    )

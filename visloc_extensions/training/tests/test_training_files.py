from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save

from visloc.errors import InvalidInput
from visloc_extensions.training.files import read_about, write_tensors
from visloc_extensions.training.parallax import read_rooms
from visloc_extensions.training.photos import read_pack


def test_what_is_written_is_read_whatever_its_order_in_memory(tmp_path: Path) -> None:
    array = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    arrays = {"turned": array.T, "part": array[:, ::2], "one": np.array(7.5)}
    about = {"step": 3, "licences": {"ä.jpg": "CC0"}}
    path = tmp_path / "folder" / "pack"
    assert write_tensors(path, arrays, about) == path.stat().st_size
    assert read_about(path) == about
    read = load(path.read_bytes())
    for name, expected in arrays.items():
        assert read[name].shape == expected.shape
        np.testing.assert_array_equal(read[name], expected)


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    arrays = {f"a{number}": np.full(3, number, np.float32) for number in range(9)}
    about = {f"word {number}": number for number in range(9)}
    write_tensors(tmp_path / "first", arrays, about)
    write_tensors(
        tmp_path / "second", dict(reversed(arrays.items())), dict(reversed(about.items()))
    )
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"no tensors at all",
        save({"a.image": np.zeros(3, np.uint8)}),
        save({"a.image": np.zeros(3, np.uint8)}, {"about": "[]"}),
        save({"a.image": np.zeros(3, np.uint8)}, {"about": '{"licences": {}}'}),
        (87).to_bytes(8, "little")
        + b'{"a.image":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}'.ljust(87)
        + bytes(4),
    ],
)
def test_other_files_are_neither_packs_nor_rooms(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other"
    path.write_bytes(data)
    with pytest.raises(InvalidInput, match="not a pack of photos") as caught:
        read_pack(path)
    assert caught.value.code == "training.pack"
    with pytest.raises(InvalidInput, match="the rooms cannot be read") as caught:
        read_rooms(path)
    assert caught.value.code == "training.rooms"

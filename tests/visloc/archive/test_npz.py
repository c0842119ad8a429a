from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from visloc.archive.npz import read_npz

ARRAYS = {
    "a": np.arange(12, dtype="<f4").reshape(3, 4),
    "b": np.empty((0, 3), np.uint8),
    "turned": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "one": np.float64(3),
}


def npy(shape: object, descr: str = "<f4", data: bytes = b"\0" * 24) -> bytes:
    file = io.BytesIO()
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + data


def with_header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def write(path: Path, *members: tuple[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", **ARRAYS)  # type: ignore[arg-type]
    found = read_npz(tmp_path / "x.npz")
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize(
    ("name", "data", "complaint"),
    [
        ("a.npy", npy((10**15, 4)), "said to be float32"),
        ("a.npy", npy((3, 3)), "said to be float32"),
        ("a.npy", npy((2,)), "in 24 bytes"),
        ("a.npy", npy((-2, -3)), "said to be float32"),
        ("a.npy", npy((3,), "|O"), "said to be object"),
        ("a.npy", npy((24,), "|V0"), "not an array|said to be"),
        ("a.npy", with_header("(" * 5000), "not an array"),
        ("a.npy", with_header("-" * 9000 + "1"), "not an array"),
        ("a.npy", with_header("{'descr': '''"), "not an array"),
        ("a.npy", b"\x93NUMPY\x09\x00", "not an array"),
        ("a.npy", b"", "not an array"),
        ("a.txt", npy((6,)), "'a.txt' is not an array"),
    ],
)
def test_what_its_header_does_not_fit_is_refused_unread(
    tmp_path: Path, name: str, data: bytes, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        read_npz(write(tmp_path / "x.npz", (name, data)))


def test_compressed_entries_are_refused_unread(tmp_path: Path) -> None:
    zeros = npy((2**20,), data=b"\0" * 2**22)
    for compression in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        path = write(tmp_path / "x.npz", ("a.npy", zeros), compression=compression)
        with pytest.raises(ValueError, match="compressed"):
            read_npz(path)


def test_an_array_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate"):
        path = write(tmp_path / "x.npz", ("a.npy", npy((6,))), ("a.npy", npy((6,))))
    with pytest.raises(ValueError, match="twice"):
        read_npz(path)


@pytest.mark.parametrize("field", ["file_size", "flag_bits"])
def test_entries_that_lie_about_themselves_are_refused(
    tmp_path: Path, field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "x.npz", ("a.npy", npy((6,))))
    true_infolist = zipfile.ZipFile.infolist

    def lying(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
        entries = true_infolist(archive)
        for entry in entries:
            setattr(entry, field, 2**40 + 1)
        return entries

    monkeypatch.setattr(zipfile.ZipFile, "infolist", lying)
    with pytest.raises(ValueError, match="compressed or encrypted"):
        read_npz(path)


@pytest.mark.parametrize("cut", [0, 10, 100, -1, -60])
def test_cut_off_archives_are_refused(tmp_path: Path, cut: int) -> None:
    path = write(tmp_path / "x.npz", ("a.npy", npy((6,))))
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"."):
        read_npz(path)


def test_altered_bytes_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "x.npz", ("a.npy", npy((6,), data=b"altered?" * 3)))
    path.write_bytes(path.read_bytes().replace(b"altered?", b"altered!"))
    with pytest.raises(ValueError, match="CRC"):
        read_npz(path)


def test_a_missing_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_npz(tmp_path / "x.npz")

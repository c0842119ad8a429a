from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.maps.packing import write_packed
from visloc.archive import MapStore, verify_map
from visloc.archive.packed import unpack_map
from visloc.errors import Conflict, MapCorrupt


def test_the_command_packs_a_map_that_unpacks_whole(built_maps: Path, tmp_path: Path) -> None:
    opened = MapStore(built_maps).open("room")
    file = tmp_path / "room.zip"

    result = CliRunner().invoke(
        app,
        ["pack", "room", "--maps-dir", str(built_maps), "--output", str(file)],
        env={"COLUMNS": "200"},
    )

    assert result.exit_code == 0, result.output
    assert result.output.startswith(f"{opened.ref}: {file}, ")
    unpack_map(file, tmp_path / "map", 2**30)
    assert verify_map(tmp_path / "map").manifest == opened.manifest
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_a_damaged_map_is_not_packed(maps_dir: Path, tmp_path: Path) -> None:
    folder = MapStore(maps_dir).folder("room")
    with (folder / "landmarks.npy").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x55")

    with pytest.raises(MapCorrupt, match=r"landmarks\.npy"):
        write_packed(folder, tmp_path / "room.zip")
    assert not list(tmp_path.glob("*.zip"))


def test_an_existing_file_is_kept(built_maps: Path, tmp_path: Path) -> None:
    file = tmp_path / "room.zip"
    file.write_text("mine")

    with pytest.raises(Conflict) as caught:
        write_packed(MapStore(built_maps).folder("room"), file)
    assert caught.value.code == "pack.output_exists"
    assert file.read_text() == "mine"

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.maps.upgrading import lacking, upgrade_map
from mapping.own_test.trials import own_test
from visloc.archive import Map, MapStore, sha256_of, verify_map
from visloc.archive.checks import content_hash, json_text, manifest_hash
from visloc.errors import Conflict
from visloc.retrieval.index import retrieve


@pytest.fixture
def old(build_sample: Callable[..., Map], tmp_path: Path) -> MapStore:
    """A store with the sample as a program of format 2.2 wrote it."""
    built = build_sample()
    shutil.copytree(built.path.parent, tmp_path / "maps" / "room")
    (tmp_path / "maps/room/current").write_text(built.manifest.version + "\n")
    path = tmp_path / "maps/room" / built.manifest.version / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["parts"]
    manifest["format_version"] = "2.2"
    manifest["content_hash"] = content_hash(manifest)
    manifest["manifest_hash"] = manifest_hash(manifest)
    path.write_text(json_text(manifest))
    return MapStore(tmp_path / "maps")


def test_an_upgraded_map_has_its_own_test_over_the_same_files(old: MapStore) -> None:
    before = verify_map(old.folder("room"))
    folder = upgrade_map(before, old.root)
    after = verify_map(folder)
    assert old.current_version("room") == after.manifest.version != before.manifest.version
    assert after.manifest.format_version == "3.2"
    assert after.manifest.files == before.manifest.files
    assert after.manifest.parts.own_test == own_test(before)
    assert before.manifest.parts.own_test is None
    assert verify_map(before.path).manifest == before.manifest


def test_there_is_nothing_to_add_twice(old: MapStore) -> None:
    folder = upgrade_map(old.open("room"), old.root)
    with pytest.raises(Conflict) as caught:
        upgrade_map(verify_map(folder), old.root)
    assert caught.value.code == "map.upgraded"


def test_a_version_that_is_not_in_use_is_not_upgraded(old: MapStore) -> None:
    before = old.open("room")
    upgrade_map(before, old.root)
    with pytest.raises(Conflict) as caught:
        upgrade_map(before, old.root)
    assert caught.value.code == "map.outdated"
    assert len(old.versions("room")) == 2


def test_an_upgrade_that_fails_leaves_the_map_as_it_was(
    old: MapStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Map) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mapping.maps.upgrading.own_test", fail)
    before = old.open("room")
    with pytest.raises(KeyboardInterrupt):
        upgrade_map(before, old.root)
    assert old.versions("room") == [before.manifest.version]
    assert verify_map(old.folder("room")).manifest == before.manifest


def test_the_command_says_what_was_added(old: MapStore) -> None:
    result = CliRunner().invoke(app, ["upgrade", "room", "--maps-dir", str(old.root)])
    assert result.exit_code == 0
    assert "own test added" in result.output
    shown = CliRunner().invoke(app, ["inspect", "room", "--maps-dir", str(old.root)])
    assert "photos localized without themselves" in " ".join(shown.output.split())


def test_what_only_a_new_build_can_add_is_said(old: MapStore) -> None:
    opened = old.open("room")
    assert lacking(opened) == []
    features = opened.manifest.local_features.model_copy(
        update={"keypoint_step_px": None, "computed_with": None}
    )
    before_2_0 = replace(
        opened, manifest=opened.manifest.model_copy(update={"local_features": features})
    )
    assert [line.partition(": ")[2].split(":")[0] for line in lacking(before_2_0)] == [
        "keypoints and global descriptors stay in 32 bits",
        "what computed the features stays unknown",
    ]


def test_the_command_that_a_warning_names_ends_the_warning(
    old: MapStore, caplog: pytest.LogCaptureFixture
) -> None:
    """Formats 2.0 to 3.0 had another index, of which one file has the same name."""
    before = with_old_index(old.folder("room"))
    opened = verify_map(before)
    assert not opened.has_index
    (command,) = re.findall(r"`mapping (upgrade \S+)`", caplog.text)

    result = CliRunner().invoke(app, [*command.split(), "--maps-dir", str(old.root)])

    assert result.exit_code == 0, result.output
    assert "own test and index added" in result.output
    caplog.clear()
    after = verify_map(old.folder("room"))
    assert not caplog.records
    assert after.has_index
    assert all(record.clusters is None for record in after.manifest.global_features)
    query = {name: rows[1] for name, rows in after.global_descriptors.items()}
    best = retrieve(query, opened.global_descriptors, 3)
    assert np.array_equal(retrieve(query, after.global_descriptors, 3).images, best.images)
    assert not verify_map(before).has_index
    again = CliRunner().invoke(app, [*command.split(), "--maps-dir", str(old.root)])
    assert again.exit_code != 0


def test_a_large_map_gets_an_index(old: MapStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapping.maps.upgrading.MAX_EXACT", 2)
    after = verify_map(upgrade_map(old.open("room"), old.root))
    assert after.has_index
    with pytest.raises(Conflict):
        upgrade_map(after, old.root)


def with_old_index(folder: Path) -> Path:
    """Give a map the index of formats 2.0 to 3.0, as far as it is still looked at."""
    name = "index/densevlad.centers.npy"
    (folder / "index").mkdir()
    (folder / name).write_bytes(b"centers")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"][name] = {"size": 7, "sha256": sha256_of(folder / name)}
    for record in manifest["global_features"]:
        record["clusters"] = 4
        record.pop("lists", None)
    manifest["content_hash"] = content_hash(manifest)
    manifest["manifest_hash"] = manifest_hash(manifest)
    (folder / "manifest.json").write_text(json_text(manifest))
    return folder

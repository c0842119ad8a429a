from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from tests.mapping.cli.test_mapping_cli import Run, error_of
from visloc.kapture import read_dataset, write_dataset


def test_help_names_the_command(run: Run) -> None:
    status, out, err = run("calibrate-rig", "--help")
    assert (status, err) == (0, "")
    assert "mapping calibrate-rig" in out


def test_missing_dataset_is_one_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    error = error_of(run("calibrate-rig", "nowhere"))
    assert "error [kapture.no_dataset] sensors/sensors.txt: nowhere" in error
    assert not list(tmp_path.iterdir())


def test_a_rig_is_calibrated_shown_and_written_once(run: Run, sample: Path, tmp_path: Path) -> None:
    known = read_dataset(sample / "mapping")
    poses = {(r.timestamp, r.sensor_id): known.pose(r) for r in known.images}
    write_dataset(
        replace(known, root=tmp_path, rigs={}, trajectories=poses)  # type: ignore[arg-type]
    )
    command = ("calibrate-rig", tmp_path, "--rig", "car", "--reference", "right")
    output = tmp_path / "sensors" / "rigs.txt"
    status, out, err = run(*command, "--cameras", "left, right")
    assert (status, err) == (0, "")
    assert "rig car, its frame is camera right" in out
    assert re.search(r"left +right +4 +0 +0 / 0 +0 / 0 +-0.1999", out)
    assert out.endswith(f"rig: {output}\n")
    assert list(read_dataset(tmp_path).rigs["car"]) == ["right", "left"]

    text = output.read_text()
    error = error_of(run(*command))
    assert f"error [rig.exists] {output}" in error
    assert "--output" in error
    assert output.read_text() == text
    assert run(*command, "--output", tmp_path / "new" / "rigs.txt")[0] == 0
    assert "left" in (tmp_path / "new" / "rigs.txt").read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--cameras", "left,roof"),
            "[rig.cameras] --cameras: the dataset does not have these cameras",
        ),
        (("--cameras", ""), "[rig.cameras] --cameras: a rig needs at least two cameras"),
        (("--reference", "roof"), "[rig.reference] --reference: the reference is not one"),
        (("--rig", "left"), "[rig.id] --rig: this is not a valid id of a rig"),
        (("--rig", "a,b"), "[kapture.field]"),
    ],
)
def test_a_rig_that_cannot_be_calibrated_is_one_line(
    run: Run, sample: Path, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    output = tmp_path / "rigs.txt"
    error = error_of(run("calibrate-rig", sample / "mapping", "--output", output, *options))
    assert f"error {said}" in error
    assert not output.exists()

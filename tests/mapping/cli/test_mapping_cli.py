from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pycolmap
import pytest
from rich.console import ConsoleDimensions

from mapping.cli import main as cli
from mapping.pairing import PAIRINGS
from visloc.archive import MapStore, open_map
from visloc.kapture import read_dataset

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command in this process; return exit status, stdout and stderr."""
    monkeypatch.delenv("VISLOC_MAPS_DIR", raising=False)
    monkeypatch.delenv("VISLOC_WEIGHTS_DIR", raising=False)
    # On a busy machine, a step that takes long would tell so on stderr.
    monkeypatch.setattr("mapping.cli.progress._LINE_EVERY_S", 3600.0)

    def run_command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["mapping", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            cli.main()
        out, err = capsys.readouterr()
        return int(left.value.code or 0), out, err

    return run_command


def error_of(outcome: tuple[int, str, str]) -> str:
    """The only line of a command that failed."""
    status, out, err = outcome
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1
    return err


def test_inspect_gives_json_for_programs(run: Run, built_maps: Path) -> None:
    status, out, err = run("inspect", "room", "--maps-dir", built_maps, "--json")
    assert (status, err) == (0, "")
    opened = MapStore(built_maps).open("room")
    summary = json.loads(out)
    assert summary["id"] == "room"
    assert summary["version"] == opened.manifest.version
    assert summary["counts"] == {
        "images": 8,
        "landmarks": len(opened.landmarks),
        "observations": len(opened.observation_landmarks),
    }
    assert summary["local_features"]["fingerprint"]["name"] == "sift"
    assert summary["local_features"]["computed_with"] == f"OpenCV {cv2.__version__}"
    assert [g["fingerprint"]["name"] for g in summary["global_features"]] == [
        *("densevlad", "localvlad"),
    ]
    assert summary["size_bytes"] == opened.size_bytes
    assert summary["world"]["extent"]["min"] < summary["world"]["extent"]["max"]
    assert summary["method"]["name"] == "rgbd"
    assert summary["rigs"] == {"rig": ["left", "right"]}
    assert summary["gravity"] is None


@pytest.mark.parametrize("by", ["id", "version", "folder"])
def test_inspect_shows_people_what_a_map_holds(run: Run, built_maps: Path, by: str) -> None:
    opened = MapStore(built_maps).open("room")
    ref = {"id": "room", "version": opened.ref, "folder": str(opened.path)}[by]
    status, out, err = run("inspect", ref, "--maps-dir", built_maps)
    assert (status, err) == (0, "")
    for shown in (
        *("rig: left, right", "not known"),
        *(opened.ref, "8 by 2 cameras", str(len(opened.landmarks)), "sift, 128 dimensions"),
        *(str(len(opened.observation_landmarks)), "densevlad", "localvlad", " m", "MiB"),
    ):
        assert shown in out


def test_the_folder_of_maps_can_come_from_the_environment(
    run: Run, built_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VISLOC_MAPS_DIR", str(built_maps))
    assert run("inspect", "room")[0] == 0


def test_verify_passes_a_map_as_published(run: Run, built_maps: Path) -> None:
    status, out, err = run("verify", "room", "--maps-dir", built_maps)
    assert (status, err) == (0, "")
    assert "17 files, every byte as published" in out
    assert "sift, densevlad, localvlad: the same features as here" in out


@pytest.mark.parametrize(
    "name", ["landmarks.npy", "observation_descriptors.npy", "images.json", "manifest.json"]
)
def test_verify_names_the_file_in_which_one_bit_was_flipped(
    run: Run, maps_dir: Path, name: str
) -> None:
    path = MapStore(maps_dir).folder("room") / name
    content = bytearray(path.read_bytes())
    # In the middle of a manifest may be the name of another file.
    at = content.index(b'"created": "') + 14 if name == "manifest.json" else len(content) // 2
    content[at] ^= 1
    path.write_bytes(content)
    error = error_of(run("verify", "room", "--maps-dir", maps_dir))
    assert error.startswith("error [map.")
    assert str(path) in error


def test_verify_tells_that_the_features_of_a_map_are_others(
    run: Run, maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from visloc.features.local.sift import SiftExtractor

    other = replace(SiftExtractor.fingerprint, revision=2)
    monkeypatch.setattr(SiftExtractor, "fingerprint", other)
    status, out, err = run("verify", "room", "--maps-dir", maps_dir)
    assert status == 1
    assert "every byte as published" in out
    assert "the same features" not in out
    assert "[map.features]" in err
    assert "expected revision 1, got revision 2" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ("inspect", "kitchen"),
            "[map.unknown] map: there is no such map (expected one of room, got",
        ),
        (("inspect", "room@v9"), "[map.version] map: map room has no such version"),
        (("verify", "../room"), "[map.id] map: this is not a valid name of a map"),
        (("build", "nowhere", "--map", "new"), "[kapture.no_dataset] sensors/sensors.txt: nowhere"),
        (("build", "nowhere", "--map", "room"), "[map.exists] --map: map 'room' exists"),
        (
            ("build", "nowhere", "--map", "new", "--local-features", "surf"),
            "[features.unknown] local_features: the features are unknown; if a package provides",
        ),
        (("build", "x", "--map", "new", "--method", "nerf"), "[build.method] --method"),
        (("build", "x", "--map", "new", "--pairs", "near"), "[build.pairs] --pairs"),
        (("build", "x", "--map", "new", "--poses", "guess"), "[build.poses] --poses"),
        (("build", "x", "--map", "new", "--mapper", "c3"), "[build.mapper] --mapper"),
        (("build", "x", "--map", "new", "--refine", "all"), "[build.refine] --refine"),
        (("build", "x", "--map", "new", "--max-angle", "270"), "[pairs.max_angle] --max-angle"),
        (("build", "x", "--map", "new", "--near", "9", "--far", "2"), "[pairs.far] --far"),
        (("build", "x", "--map", "new", "--covisible-in", "y"), "[map.unknown]"),
        (
            ("build", "x", "--map", "new", "--gravity", "down"),
            "[build.gravity] --gravity: this is not a",
        ),
        (
            ("build", "x", "--map", "new", "--gravity", "0,0"),
            "[build.gravity] --gravity: this is not a",
        ),
        (
            ("build", "x", "--map", "new", "--gravity", "0,0,0"),
            "[build.gravity] --gravity: this is not a",
        ),
        (("build", "x", "--map", "new", "--gravity", "0,nan,1"), "[build.gravity] --gravity"),
        (("import", "colmap", "x"), "[import.target] --map: say whether to make"),
        (("import", "colmap", "x", "--map", "m", "--output", "o"), "[import.target] --map"),
        (("import", "meshroom", "x", "--output", "o"), "[import.unknown_format] FORMAT"),
        (("export", "room", "--output", "o", "--format", "e57"), "[export.unknown_format] --f"),
        (("export", "attic", "--output", "o"), "[map.unknown] map: there is no such map"),
    ],
)
def test_an_error_is_one_line_with_its_code(
    run: Run,
    built_maps: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VISLOC_MAPS_DIR", str(built_maps))
    assert f"error {said}" in error_of(run(*arguments))
    assert not list(tmp_path.iterdir())


def test_missing_weights_are_refused_before_any_photo(
    run: Run, sample: Path, tmp_path: Path
) -> None:
    command = ("build", sample / "mapping", "--map", "new", "--maps-dir", tmp_path)
    error = error_of(run(*command, "--local-features", "r2d2"))
    assert (
        "error [weights.missing] weights_dir: the weights of R2D2 are not part of this software: "
        "download r2d2_WASF_N16.pt"
    ) in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--size", "640"), "[sample.size] --size: the size is not valid (expected WxH"),
        (("--size", "8x8"), "[sample.size] --size: photos of this size cannot be made"),
        (("--images", "1"), "[sample.images] --images"),
        (("--seed", "-1"), "[sample.seed] --seed"),
    ],
)
def test_sample_refuses_what_it_cannot_make(
    run: Run, tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    assert f"error {said}" in error_of(run("sample", tmp_path / "sample", *arguments))
    assert not list(tmp_path.iterdir())


def test_sample_does_not_touch_a_folder_that_holds_something(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    error = error_of(run("sample", tmp_path))
    assert f"error [sample.exists] {tmp_path}" in error
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_what_the_system_refuses_is_one_line_too(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    target = tmp_path / "file" / "sample"
    error = error_of(run("sample", target, "--images", "2", "--size", "64x48"))
    assert error.startswith("error [system] ")
    assert "Not a directory" in error


@pytest.mark.parametrize(
    "command",
    [
        *("", "build", "pairs", "import", "export", "inspect", "verify", "sample"),
    ],
)
def test_every_command_has_help(run: Run, command: str) -> None:
    status, out, err = run(*command.split(), "--help")
    assert (status, err) == (0, "")
    assert f"mapping {command}".strip() in out  # whatever started the tests comes before it


def test_a_command_starts_without_what_takes_seconds_to_load() -> None:
    code = "import sys, mapping.cli.main; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert "mapping.cli.main" in loaded
    assert not set(loaded) & {"torch", "openvino", "faiss", "scipy.stats"}


def test_build_explains_all_its_options(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("rich.console.Console.size", ConsoleDimensions(120, 200))
    _, out, _ = run("build", "--help")
    for option in (
        *("--map", "--maps-dir", "--method", "--local-features", "--global-features"),
        *("--features-dir", "--pixel-origin", "--weights-dir", "--max-keypoints", "--metric"),
        *("--workers", "--force", "--voxel-size", "--depth-sensor", "--depth-scale", "--pairs"),
        *("--top-k", "--max-distance", "--max-angle", "--near", "--far", "--covisible-in"),
        *("--pairs-file", "--mapper", "--refine", "--poses", "--gravity", "--keep-photos"),
    ):
        assert re.search(rf"{option}\b", out), option
    for name in PAIRINGS:
        assert name in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("build",), "Missing"),
        (("inspect",), "Missing argument 'MAP'"),
        (("raze", "room"), "No such command 'raze'"),
        (("inspect", "room", "--yaml"), "No such option"),
        (
            ("build", "dataset", "--map", "m", "--max-keypoints", "many"),
            "'--max-keypoints'",
        ),
        (
            ("build", "dataset", "--map", "m", "--max-keypoints", "0"),
            "'--max-keypoints'",
        ),
        (("build", "dataset", "--map", "m", "--workers", "0"), "'--workers'"),
        (("build", "dataset", "--map", "m", "--top-k", "0"), "'--top-k'"),
        (("build", "dataset", "--map", "m", "--pixel-origin", "left"), "'--pixel-origin'"),
    ],
)
def test_wrong_usage_exits_with_2(run: Run, arguments: tuple[str, ...], said: str) -> None:
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert said in err


def test_build_shows_each_stage_and_what_was_made(run: Run, sample: Path, tmp_path: Path) -> None:
    status, out, err = run(
        *("build", sample / "mapping", "--map", "room", "--maps-dir", tmp_path),
        *("--local-features", "sift", "--global-features", "localvlad"),
    )
    assert status == 0
    # On a busy machine, stages also say how far they are.
    ends = [line for line in err.splitlines() if not re.search(r" after \d+ s", line)]
    stages = [re.fullmatch(r"([a-z ]+): (\d+)/\2 in [\d.]+ s", line) for line in ends]
    assert [stage and stage[1] for stage in stages] == [
        *(
            "photos",
            "local features",
            "localvlad words",
            "localvlad",
            "given poses",
            "depth",
            "own test",
        ),
    ]
    opened = open_map(MapStore(tmp_path).folder("room"))
    assert opened.ref in out
    assert "peak memory" in out
    assert list(opened.global_descriptors) == ["localvlad"]


@pytest.mark.parametrize(("format_name", "made"), [("colmap", 3), ("kapture", 2), ("ply", 0)])
def test_a_map_is_exported_once(
    run: Run, built_maps: Path, tmp_path: Path, format_name: str, made: int
) -> None:
    command = ("export", "room", "--maps-dir", built_maps, "--format", format_name, "--output")
    status, out, err = run(*command, tmp_path / "out")
    assert (status, err) == (0, "")
    assert out == f"{format_name}: {tmp_path / 'out'}\n"
    if format_name == "ply":
        assert (tmp_path / "out").read_bytes().startswith(b"ply\n")
    else:
        assert len(list((tmp_path / "out").iterdir())) >= made
    assert "error [export.exists]" in error_of(run(*command, tmp_path / "out"))


def test_a_real_model_goes_through_a_map_and_comes_out_as_it_was(
    run: Run, shared_data: Path, tmp_path: Path
) -> None:
    door = shared_data / "import_samples" / "lund_door" / "colmap"
    maps = ("--maps-dir", tmp_path / "maps")
    few = ("--local-features", "sift", "--global-features", "localvlad", "--max-keypoints", "500")
    status, out, _ = run("import", "colmap", door, "--map", "door", *maps, *few)
    assert status == 0
    assert "12 photos by 1 cameras, 12 with a pose" in out
    assert "11384 points, 73327 observations, not known to be metric" in out
    assert not list((tmp_path / "maps" / ".work").glob("door*/*"))
    opened = MapStore(tmp_path / "maps").open("door")
    assert opened.manifest.method.name == "model"
    assert not opened.manifest.world.metric

    assert run("export", "door", *maps, "--output", tmp_path / "model")[0] == 0
    before, after = pycolmap.Reconstruction(door), pycolmap.Reconstruction(tmp_path / "model")
    (old,), (new,) = before.cameras.values(), after.cameras.values()
    assert (new.model, new.width, new.height) == (old.model, old.width, old.height)
    assert np.array_equal(new.params, old.params)
    images = {image.name: image for image in before.images.values()}
    assert len(after.images) == len(images) == 12
    for image in after.images.values():
        pose, known = image.cam_from_world(), images[image.name].cam_from_world()
        # Quaternions of six digits there have the length 1 only after scaling.
        np.testing.assert_allclose(pose.matrix(), known.matrix(), rtol=0, atol=1e-6)
    np.testing.assert_allclose(  # single precision in the map
        [after.points3D[key].xyz for key in sorted(after.points3D)],
        [before.points3D[key].xyz for key in sorted(before.points3D)],
        rtol=0,
        atol=2e-6,
    )


def test_an_imported_dataset_is_written_once(run: Run, shared_data: Path, tmp_path: Path) -> None:
    door = shared_data / "import_samples" / "lund_door" / "colmap"
    status, out, err = run("import", "colmap", door, "--output", tmp_path / "door")
    assert (status, err) == (0, "")
    dataset, then = out.splitlines()[-2:]
    assert dataset == f"dataset: {tmp_path / 'door'}"
    assert then.endswith("door --map ID --method model --not-metric")
    assert len(read_dataset(tmp_path / "door").images) == 12
    error = error_of(run("import", "colmap", door, "--output", tmp_path / "door"))
    assert f"error [import.exists] {tmp_path / 'door'}" in error


def test_an_import_says_how_to_build_with_all_that_it_read(run: Run, tmp_path: Path) -> None:
    for name, mode in (("a.jpg", "RGB"), ("d.png", "I;16"), ("m.png", "L")):
        PIL.Image.new(mode, (64, 48)).save(tmp_path / name)
    frame = {"file_path": "a.jpg", "depth_file_path": "d.png", "mask_path": "m.png"}
    frame |= {"transform_matrix": np.eye(4).tolist(), "sharpness": 1.0}
    top = {"fl_x": 50, "integer_depth_scale": 0.00015, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(top))
    status, out, _ = run("import", "nerfstudio", tmp_path, "--output", tmp_path / "out")
    assert status == 0
    assert "fields that are not read: frames[].sharpness (1)" in out
    assert out.splitlines()[-1].endswith(
        f"--method rgbd --metric --depth-scale 0.00015 --masks {tmp_path / 'out' / 'masks'}"
    )


def test_pairs_are_written_without_a_build_and_once(run: Run, sample: Path, tmp_path: Path) -> None:
    output = tmp_path / "pairs.txt"
    arguments = ("pairs", sample / "mapping", "--output", output, "--pairs", "distance,sequence")
    status, out, _ = run(*arguments, "--top-k", "3")
    assert status == 0
    lines = output.read_text().splitlines()
    assert lines[0] == "# query_image, map_image, score"
    assert out.startswith(f"{len(lines) - 1} pairs: {output}")
    names = {record.path for record in read_dataset(sample / "mapping").images}
    assert {name for line in lines[1:] for name in line.split(", ")[:2]} <= names

    status, _, err = run(*arguments)
    assert status == 1
    assert f"error [pairs.exists] {output}" in err


def test_pairs_that_need_no_poses_take_photos_without(
    run: Run, sample: Path, tmp_path: Path
) -> None:
    dataset = shutil.copytree(sample / "mapping", tmp_path / "unposed")
    (dataset / "sensors" / "trajectories.txt").unlink()
    photos = len(read_dataset(dataset).images)

    status, out, _ = run(
        "pairs", dataset, "--output", tmp_path / "all.txt", "--pairs", "exhaustive"
    )

    assert (status, out.split()[0]) == (0, str(photos * (photos - 1) // 2))
    _, _, err = run("pairs", dataset, "--output", tmp_path / "near.txt", "--pairs", "distance")
    assert "error [dataset.no_photos]" in err
    assert f"{photos} of {photos} photos have no pose" in err


def test_pairs_by_pose_say_which_photos_they_leave_out(
    run: Run, sample: Path, tmp_path: Path
) -> None:
    dataset = shutil.copytree(sample / "mapping", tmp_path / "partly")
    poses = dataset / "sensors" / "trajectories.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:-2]))

    status, out, _ = run("pairs", dataset, "--output", tmp_path / "near.txt", "--pairs", "distance")

    assert status == 0
    assert re.search(r"^note: \d of 8 photos have no pose: \S+", out, re.M)


@pytest.mark.parametrize(
    ("pairs", "code"),
    [("retrieval", "pairs.no_global_descriptors"), ("covisibility", "pairs.no_tracks")],
)
def test_pairs_that_need_what_is_not_there_say_what(
    run: Run, sample: Path, tmp_path: Path, pairs: str, code: str
) -> None:
    output = tmp_path / "pairs.txt"
    status, _, err = run("pairs", sample / "mapping", "--output", output, "--pairs", pairs)
    assert status == 1
    assert f"error [{code}]" in err
    assert not output.exists()


@pytest.mark.parametrize("map_id", ["../../victim", ".hidden", "a/b", ""])
def test_an_import_to_what_is_no_id_touches_nothing(run: Run, tmp_path: Path, map_id: str) -> None:
    precious = tmp_path / "victim.imported" / "precious"
    precious.mkdir(parents=True)
    error = error_of(
        run("import", "colmap", tmp_path, "--map", map_id, "--maps-dir", tmp_path / "m")
    )
    assert "[map.id]" in error
    assert precious.is_dir()


def test_gravity_is_in_the_map_and_shown(run: Run, sample: Path, tmp_path: Path) -> None:
    maps = ("--maps-dir", tmp_path)
    status, out, _ = run(
        *("build", sample / "mapping", "--map", "room", *maps, "--gravity", "-3,0,-4"),
        *("--local-features", "sift", "--global-features", "localvlad"),
    )
    assert status == 0
    assert "down is (-0.6, 0, -0.8)" in out
    opened = MapStore(tmp_path).open("room")
    assert opened.gravity is not None
    assert opened.gravity.tolist() == [-0.6, 0.0, -0.8]
    assert json.loads(run("inspect", "room", *maps, "--json")[1])["gravity"] == [-0.6, 0.0, -0.8]


def test_ctrl_c_ends_a_build_with_130_and_says_that_it_resumes(
    sample: Path, tmp_path: Path
) -> None:
    # A shell starts what it runs in the background with SIGINT ignored, tests perhaps too.
    heed_sigint = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    run = f"{heed_sigint}; from mapping.cli.main import main; main()"
    command = [sys.executable, "-c", run, "build", str(sample / "mapping")]
    process = subprocess.Popen(
        [*command, "--map=room", f"--maps-dir={tmp_path}", "--local-features=sift"],
        stderr=subprocess.PIPE,
        text=True,
        env={name: value for name, value in os.environ.items() if "VISLOC" not in name},
    )
    with process:
        assert process.stderr is not None
        first = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert first.startswith("photos: 8/8")
    assert process.returncode == 130
    assert rest.splitlines()[-1] == "stopped; the same command resumes where it was"
    assert "Traceback" not in rest
    assert MapStore(tmp_path).ids() == []

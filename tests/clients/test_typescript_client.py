"""The TypeScript client in Node.js, with the service as it is, and what its package contains."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import visloc
from tests.serving import serving
from visloc.evaluation import pose_error
from visloc.geometry import Pose

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "web" / "client"

pytestmark = [
    pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js: `node` on PATH"),
    pytest.mark.skipif(
        not (PACKAGE / "dist" / "index.js").is_file(),
        reason="needs the built client, which `make page` makes",
    ),
]


@pytest.fixture(scope="module")
def seen(
    built_maps: Path, queries: list[Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Any]]:
    """What the client got; the queries are also the cameras of a rig at the world's origin."""
    camera, sensors = _json_of(queries[0].camera), {}
    for i, query in enumerate(queries):
        pose = query.cam_from_world
        transform = {
            "rotation_wxyz": pose.rotation_wxyz.tolist(),
            "translation": pose.translation.tolist(),
        }
        sensors[f"cam{i}"] = {"cam_from_rig": transform, "camera": _json_of(query.camera)}
    with serving(built_maps, tmp_path_factory.mktemp("service") / "log") as url:
        given = {
            **{"url": url, "map": "room", "camera": camera, "rig": {"sensors": sensors}},
            "photos": [str(query.path) for query in queries],
        }
        done = subprocess.run(
            ["node", str(Path(__file__).with_name("typescript_client.mjs"))],
            input=json.dumps(given),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        yield json.loads(done.stdout)


def _json_of(camera: Any) -> dict[str, Any]:
    names = ("model", "width", "height", "params")
    return {name: getattr(camera, name) for name in names}


def test_a_photo_is_localized(seen: dict[str, Any], query: Any) -> None:
    answer = seen["answer"]
    assert answer["status"] == "localized"
    sent = answer["pose"]["cam_from_world"]
    pose = Pose.from_quaternion(sent["rotation_wxyz"], sent["translation"])
    metres, degrees = pose_error(pose, query.cam_from_world)
    assert metres < 0.01
    assert degrees < 0.1


def test_its_matrix_is_where_the_camera_was(seen: dict[str, Any], query: Any) -> None:
    matrix = np.reshape(seen["matrix"], (4, 4)).T
    backward = -query.cam_from_world.rotation[2]  # of the camera, in the world
    np.testing.assert_allclose(matrix[:3, 3], query.cam_from_world.center, atol=0.01)
    np.testing.assert_allclose(matrix[:3, 2], backward, atol=0.002)
    np.testing.assert_allclose(np.reshape(seen["identity"], (4, 4)), np.eye(4), atol=1e-9)


def test_a_rig_is_localized(seen: dict[str, Any], queries: list[Any]) -> None:
    rig = seen["rig"]
    assert rig["status"] == "localized"
    sent = rig["pose"]["rig_from_world"]
    metres, degrees = pose_error(
        Pose.from_quaternion(sent["rotation_wxyz"], sent["translation"]), Pose.identity()
    )
    assert metres < 0.005
    assert degrees < 0.05
    assert [image["sensor"] for image in rig["images"]] == [f"cam{i}" for i in range(len(queries))]


def test_the_instants_of_a_sequence_are_localized_and_the_gap_is_filled(
    seen: dict[str, Any], queries: list[Any]
) -> None:
    first, gap, last = seen["sequence"]
    assert [each["timestamp"] for each in (first, gap, last)] == [0, 1, 2]
    sources = [each["source"] for each in (first, gap, last)]
    assert sources == ["estimated", "interpolated", "estimated"]
    for each, query in zip((first, last), queries[:2], strict=True):
        sent = each["pose"]["rig_from_world"]
        pose = Pose.from_quaternion(sent["rotation_wxyz"], sent["translation"])
        metres, degrees = pose_error(pose, query.cam_from_world)
        assert metres < 0.01
        assert degrees < 0.1


def test_a_sequence_ends_where_its_caller_leaves_or_with_its_error(seen: dict[str, Any]) -> None:
    sequences = seen["sequences"]
    assert sequences["left"] == {"answers": ["localized"]}
    assert sequences["photo"] == {"answers": ["localized", "not_localized"]}  # it is no photo
    assert sequences["aborted"] == {"answers": [], "message": "given up"}
    for name, code, field in (
        ("disordered", "sequence.timestamps", "instants[1].timestamp"),
        ("unknown", "map.unknown", "map"),
    ):
        assert sequences[name]["answers"] == []
        assert (sequences[name]["code"], sequences[name]["field"]) == (code, field)


def test_the_map_and_its_landmarks_are_read(seen: dict[str, Any]) -> None:
    assert seen["maps"] == {"listed": "room", "asked": seen["points"]["total"]}
    assert seen["points"]["count"] == 100
    assert seen["points"]["bytes"] == 1600
    assert seen["images"] == 2
    assert "top_k" in seen["options"]


def test_what_is_refused_has_its_code_and_field(seen: dict[str, Any]) -> None:
    refused = seen["refused"]
    assert refused["map"]["code"] == "map.unknown"
    assert refused["camera"] == {"code": "camera.param_count", "field": "camera.params"}
    assert refused["photo"]["code"].startswith("image.")
    assert refused["aborted"] == "given up"
    assert refused["elsewhere"]["code"] == "server.unreachable"


@pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm")
def test_the_package_contains_what_it_names_and_nothing_else() -> None:
    done = subprocess.run(
        ["npm", "pack", "--dry-run", "--json"],
        cwd=PACKAGE,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    (packed,) = json.loads(done.stdout)
    modules = {path.stem for path in (PACKAGE / "src").glob("*.ts")}
    built = {f"dist/{name}{kind}" for name in modules for kind in (".js", ".d.ts")}
    assert {file["path"] for file in packed["files"]} == {
        *("package.json", "README.md", "LICENSE"),
        *built,
    }
    manifest = json.loads((PACKAGE / "package.json").read_bytes())
    assert manifest["version"] == visloc.__version__
    assert "dependencies" not in manifest
    entry = manifest["exports"]["."]
    assert {Path(path).as_posix() for path in entry.values()} <= built

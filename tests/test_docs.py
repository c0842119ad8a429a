"""What README.md and docs/ say is so: examples run, names exist, tables are complete."""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import Field, asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from pydantic import BaseModel

import clients.cli.main
import mapping.cli.main
from clients.cli.options import KEY_VARIABLE
from mapping.maps.export import export_map
from service.errors import STATUSES
from service.settings import CONFIG_VARIABLE, PREFIX, ServiceSettings, read_settings
from tests import docs_check, error_docs, option_docs
from tests.docs_check import ASKS_NO_SERVER, commands_of
from visloc.archive import MapStore
from visloc.errors import InvalidInput, catalogue
from visloc.geometry import Camera, Pose
from visloc.options import PRESETS, LocalizeOptions
from visloc.pose.motion import position_covariance
from visloc.types import Reason
from visloc_api.words.answers import InstantAnswer, LocalizeResponse
from visloc_api.words.maps import MapInfo
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.poses import PoseEstimate
from visloc_api.words.rigs import LocalizeRigRequest
from visloc_api.words.scenes import MapImages
from visloc_api.words.sequences import LocalizeSequenceRequest
from visloc_api.words.status import Problem

ROOT = Path(__file__).resolve().parents[1]
FIRST_STEPS, API = ROOT / "docs" / "first-steps.md", ROOT / "docs" / "api.md"
PAGES = [
    page
    for pattern in ("*.md", "docs/**/*.md", "visloc_extensions/*/README.md")
    for page in sorted(ROOT.glob(pattern))
]
COMMANDS = Path(sys.executable).parent

# Reading


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language; shell has none."""
    found = re.findall(r"^```(\S*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    return [text for name, text in found if name == language]


def shell_lines(page: Path) -> list[str]:
    """The commands of a page that a reader pastes after ``make install``, each on one line."""
    known = ("make", "curl", ".venv/bin/")
    commands = (c for c in commands_of(page) if not (c.is_python or c.is_inline or c.saved_as))
    return [command.text for command in commands if command.text.startswith(known)]


def table(first_column: str) -> list[list[str]]:
    """The rows of the table of docs/api.md whose header begins so."""
    lines = iter(API.read_text().splitlines())
    next(line for line in lines if line.startswith(f"| {first_column} |"))
    next(lines)
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def words(cell: str) -> list[str]:
    """What a cell has in backticks."""
    return re.findall(r"`([^`]+)`", cell)


def in_pages(pattern: str) -> list[Any]:
    """Everything that a pattern finds, on any page."""
    return [found for page in PAGES for found in re.findall(pattern, page.read_text(), re.M)]


# Examples


@dataclass(frozen=True)
class Desk:
    """Where the examples are pasted: a folder, and a service that runs."""

    folder: Path
    http: str
    grpc: str
    camera: Camera
    center: NDArray[np.float64]

    @property
    def camera_text(self) -> str:
        camera = self.camera
        return ",".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))

    def paste(self, text: str) -> str:
        """The text with what is different on every reader's desk replaced."""
        for pattern, replacement in (
            (r"127\.0\.0\.1:8000", self.http),
            (r"127\.0\.0\.1:50051", self.grpc),
            (r"\.venv/bin/", f"{COMMANDS}/"),
            (r"\b(kitchen|hall)\b|(?<=map[= ])sample\b|(?<=maps[/ ])sample(?=[/ ])", "room"),
            (r"(?<=\")sample(?=\")", "room"),
            (r"PINHOLE,[\d,.]+", self.camera_text),
            (r'Camera\("PINHOLE".*?\)\)', repr(self.camera)),
        ):
            text = re.sub(pattern, replacement, text)
        return text

    def run(self, *words: str) -> str:
        """Run a command and return what it printed."""
        done = subprocess.run(
            words, cwd=self.folder, capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def desk(
    sample: Path, built_maps: Path, query: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Desk]:
    """The folder that docs/first-steps.md assumes, and the service as it starts it."""
    folder = tmp_path_factory.mktemp("desk")
    for name, target in (
        ("maps", built_maps),
        ("QUERIES", sample / "query"),
        ("DATASET", sample / "mapping"),
        ("PHOTOS", sample / "mapping" / "sensors" / "records_data"),
        ("lund_door/images", sample / "mapping" / "sensors" / "records_data"),
        (".demo/dataset", sample),
        (".demo/maps", built_maps),
        ("examples", ROOT / "examples"),
    ):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(target)
    export_map(MapStore(built_maps).open("room"), folder / "lund_door" / "colmap", "colmap")
    for camera, name in (("left", "photo.jpg"), ("right", "right.jpg")):
        photo = sample / "query/sensors/records_data/query" / camera / "0001.jpg"
        shutil.copy(photo, folder / ".demo" / name)
    assert (folder / ".demo" / "photo.jpg").read_bytes() == query.image
    frame = {"file_path": "photo.jpg", "transform_matrix": np.eye(4).tolist()}
    recording = {"camera_angle_x": 1.0, "frames": [frame]}
    (folder / "RECORDING").mkdir()
    (folder / "RECORDING" / "photo.jpg").write_bytes(query.image)
    (folder / "RECORDING" / "transforms.json").write_text(json.dumps(recording))
    (line,) = (line for line in shell_lines(FIRST_STEPS) if "visloc-service" in line)
    arguments = line.replace("8000", "0").replace("50051", "0").split()
    arguments[0] = f"{COMMANDS}/visloc-service"
    with subprocess.Popen(arguments, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            ready = re.compile(r"ready: http://(\S+) grpc://(\S+), maps: room@")
            log = ""
            for log_line in process.stderr:
                log += log_line
                if found := ready.search(log_line):
                    http, grpc = found.groups()
                    yield Desk(folder, http, grpc, query.camera, query.cam_from_world.center)
                    break
            else:
                pytest.fail(f"the service did not start:\n{log}")
        finally:
            process.terminate()
            process.communicate()


@pytest.mark.parametrize(
    "code",
    [
        pytest.param(code, id=f"{page.name}-{number}")
        for page in PAGES
        for number, code in enumerate(blocks(page, "python"))
        if "/points" not in code
    ],
)
def test_python_examples_say_where_the_photo_was_taken(code: str, desk: Desk) -> None:
    printed = desk.run(sys.executable, "-c", desk.paste(code))

    position = [float(number) for number in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", printed)[:3]]
    np.testing.assert_allclose(position, desk.center, atol=0.05)


def test_the_example_that_reads_points_sees_the_map(built_maps: Path, desk: Desk) -> None:
    (code,) = (code for code in blocks(API, "python") if "/points" in code)
    opened = MapStore(built_maps).open("room")

    total, count, *middle = re.findall(
        r"-?\d+\.?\d*(?:e-?\d+)?", desk.run(sys.executable, "-c", desk.paste(code))
    )

    assert int(total) == len(opened.landmarks)
    assert int(count) == min(20_000, int(total))
    extent = opened.manifest.world.extent
    assert all(
        low < float(x) < high for low, x, high in zip(extent.min, middle, extent.max, strict=True)
    )


@pytest.mark.parametrize(
    "line",
    [
        line
        for page in PAGES
        for line in shell_lines(page)
        # The service is run above. Making maps takes long and has tests of its own, as have a map
        # of ready-made features, uploads, keys and tutorials; `make docs-check` runs those commands
        # as well.
        if page.parent.name != "tutorials"
        and not re.match(
            r"make|\.venv/bin/(visloc-service|pip |"
            r"mapping (build|capture|anchor|edit|set|split|prune|merge|update|upgrade|pack"
            r"|export-graph))"
            r"|.*/mapping import .* --map|.* --features-dir|.*/localize maps push"
            r"|.*/localize bag |.*/mapping import rosbag|.* --map with-sift"
            r"|.* https://maps\.example\.org",
            line,
        )
    ],
)
def test_shell_examples_run(line: str, desk: Desk) -> None:
    for beginning, extension in docs_check.absent().items():
        if line.startswith(f".venv/bin/{beginning} "):
            pytest.skip(f"the extension {extension} is not here")
    name, *arguments = shlex.split(desk.paste(line))
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not on this machine")
    if name.endswith("localize") and arguments[0] not in ASKS_NO_SERVER:
        arguments += ["--server", f"http://{desk.http}"]

    printed = desk.run(name, *arguments)

    if name == "curl":
        assert json.loads(printed)["status"] == "localized"


JSON_EXAMPLES = [json.loads(text) for page in PAGES for text in blocks(page, "json")]


def model_of(example: dict[str, Any]) -> type[BaseModel]:
    models = (LocalizeResponse, InstantAnswer, MapImages, MapInfo, Problem)
    (model,) = (model for model in models if model.model_fields.keys() == example.keys())
    return model


@pytest.mark.parametrize("example", JSON_EXAMPLES, ids=lambda example: model_of(example).__name__)
def test_json_examples_are_what_the_api_sends(example: dict[str, Any]) -> None:
    assert model_of(example).model_validate(example).model_dump(mode="json") == example


def test_an_answer_and_a_refusal_are_shown() -> None:
    statuses = {e["status"] for e in JSON_EXAMPLES if model_of(e) is LocalizeResponse}
    assert statuses == {"localized", "not_localized"}


@pytest.mark.parametrize("device", ["cam", "rig"])
def test_the_numbers_of_the_example_follow_the_conventions_that_it_explains(device: str) -> None:
    poses = [example["pose"] for example in JSON_EXAMPLES if example.get("pose")]
    (pose,) = (pose for pose in poses if f"{device}_from_world" in pose)
    cam_from_world = Pose.from_quaternion(*pose[f"{device}_from_world"].values())
    covariance = np.array(pose["covariance"]).reshape(6, 6)

    np.testing.assert_allclose(pose["position"], cam_from_world.center, atol=1e-4)
    world_from_cam = cam_from_world.inverse()
    np.testing.assert_allclose(pose["orientation"], world_from_cam.rotation_wxyz, atol=1e-5)
    np.testing.assert_array_equal(covariance, covariance.T)
    variance = np.diag(position_covariance(cam_from_world, covariance))
    np.testing.assert_allclose(pose["position_std"], np.sqrt(variance), rtol=0.02)
    orientation_std_deg = np.degrees(np.sqrt(np.diag(covariance)[:3]))
    np.testing.assert_allclose(pose["orientation_std_deg"], orientation_std_deg, rtol=0.02)


# Names


@pytest.mark.parametrize("page", docs_check.PAGES, ids=lambda page: page.name)
def test_every_command_is_known_and_parses(page: Path) -> None:
    skipped = []
    for command in commands_of(page):
        docs_check.judged(command)
        try:
            docs_check.parse(command)
        except docs_check.NotHere:
            skipped.append(command.text)
    if skipped:
        pytest.skip(f"parsed but for commands of extensions that are not here: {skipped}")


@pytest.mark.parametrize(
    ("text", "is_known", "parses"),
    [
        (".venv/bin/mapping build DATASET --map kitchen", True, True),
        (".venv/bin/mapping build DATASET --map kitchen --no-such-flag", True, False),
        ("mapping no-such-command", True, False),
        ("localize maps list --no-such-flag", True, False),
        (
            "OPENBLAS_NUM_THREADS=1 python -m benchmarks.tiles --work DIR --out tiles.json",
            True,
            True,
        ),
        ("python -m benchmarks.captures --no-such-flag", True, False),
        ("python benchmarks/no_such_file.py", True, False),
        ("visloc-service --no-such-flag", True, False),
        ("make no-such-target", True, False),
        ('ARGS="--no-such-flag" make bench', True, False),
        ("docker compose up", True, True),
        ("unheard-of --flag", False, True),
        ("pip install visloc", True, True),
    ],
)
def test_a_command_that_does_not_work_is_noticed(text: str, is_known: bool, parses: bool) -> None:
    command = docs_check.Command("docs/new.md", 1, text)

    with nullcontext() if is_known else pytest.raises(ValueError, match="nothing is known"):
        docs_check.judged(command)
    with nullcontext() if parses else pytest.raises(ValueError, match=r"."):
        docs_check.parse(command)


@pytest.mark.parametrize("page", ["docs/results.md", "docs/new.md"])
def test_no_page_hides_a_program_that_nobody_knows(page: str) -> None:
    with pytest.raises(ValueError, match="nothing is known"):
        docs_check.judged(docs_check.Command(page, 1, "unheard-of --flag"))


def test_every_make_target_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    printed = in_pages(r"`(make [a-z -]+)`") + in_pages(r"^(make [a-z -]*[a-z])")
    named = {word for text in printed for word in text.split()[1:]}

    assert {"demo", "test", "install"} <= named <= targets


def options_of(app: typer.Typer) -> dict[str, set[str]]:
    """The flags of each of a program's commands."""
    commands: Any = typer.main.get_command(app)
    return {
        name: {
            flag
            for parameter in command.params
            for flag in (*parameter.opts, *parameter.secondary_opts)
        }
        for name, command in commands.commands.items()
    }


def test_every_command_and_flag_exists(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        read_settings(["--help"], {})
    of_service = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
    programs = {
        "mapping": options_of(mapping.cli.main.app),
        "localize": options_of(clients.cli.main.app),
        "visloc-service": {"": of_service},
    }
    absent = docs_check.absent()
    for name, command in in_pages(r"`(mapping|localize) ([a-z][a-z-]*)"):
        assert command in programs[name] or f"{name} {command}" in absent, f"{name} {command}"
    if absent:
        pytest.skip(f"flags are not looked up without {', '.join(sorted({*absent.values()}))}")
    known = {
        flag for commands in programs.values() for flags in commands.values() for flag in flags
    }
    assert set(in_pages(r"`(--[a-z-]+)")) <= known


def test_every_variable_of_the_environment_is_a_setting() -> None:
    known = {f"{PREFIX}{name.upper()}" for name in ServiceSettings.model_fields}

    assert set(in_pages(rf"{PREFIX}[A-Z_]+")) <= {*known, CONFIG_VARIABLE, KEY_VARIABLE}


def anchor_of(heading: str) -> str:
    """The anchor that GitHub and the site give a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\((?!\w+:)([^)]+)\)", page.read_text()):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if page.name == "extensions.md" and not target.parent.exists():
            continue  # that extension is not here
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)", target.read_text(), re.M)
            assert anchor in {anchor_of(heading) for heading in headings}, link


# docs/api.md and the code


@pytest.mark.parametrize("page", error_docs.pages(), ids=lambda page: page.name)
def test_the_tables_of_error_codes_are_those_of_the_catalogue(page: Path) -> None:
    text = page.read_text()

    assert error_docs.with_tables(text) == text, "run make docs-errors"
    codes = error_docs.codes_wanted(text)
    assert len(codes) == len(set(codes))


def test_the_page_of_the_api_lists_every_code_that_its_callers_meet() -> None:
    listed = set(error_docs.codes_wanted(API.read_text()))

    assert listed == {
        code for code, entry in catalogue().items() if entry.section in ("api", "clients")
    }


def test_the_errors_have_the_statuses_that_are_listed() -> None:
    listed = {
        kind: (int(http), grpc) for kinds, http, grpc, _ in table("kind") for kind in words(kinds)
    }

    assert listed == {
        kind.__name__: (http.value, grpc.name) for kind, (http, grpc) in STATUSES.items()
    }


def test_every_reason_is_listed_with_the_stage_that_gives_it() -> None:
    listed = {words(reason)[0]: stage for stage, reason, *_ in table("stage")}
    given = {}
    for path in (ROOT / "visloc").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            for stage, reason in pairwise(node.args if isinstance(node, ast.Call) else ()):
                match stage, reason:
                    case ast.Constant(value=str(word)), ast.Attribute(ast.Name("Reason"), name):
                        given[Reason[name].value] = word

    assert set(listed) == set(Reason)
    assert len(given) > 3
    assert given.items() <= listed.items()


def test_the_fields_of_the_request_and_the_answer_are_listed() -> None:
    assert [words(row[0])[0] for row in table("field")] == list(LocalizeRequest.model_fields)
    answer = API.read_text().partition("## The answer")[2].partition("## ")[0]
    for model, prefix in ((LocalizeResponse, ""), (PoseEstimate, "pose.")):
        for name in model.model_fields:
            assert f"`{prefix}{name}" in answer
    for title, model in (("rig", LocalizeRigRequest), ("sequence", LocalizeSequenceRequest)):
        text = API.read_text().partition(f"## Localize a {title}")[2].partition("\n## ")[0]
        for name in model.model_fields:
            assert re.search(rf"`({name}|{name}\[\].*)`", text), name


def test_the_options_have_the_defaults_and_ranges_that_are_listed() -> None:
    text = API.read_text()

    assert option_docs.with_table(text) == text, "run make docs-options"
    assert [words(row[0])[0] for row in table("option")] == list(asdict(LocalizeOptions()))


@pytest.mark.parametrize(
    "option",
    [each for each in fields(LocalizeOptions) if each.metadata["range"]],
    ids=lambda option: option.name,
)
def test_options_out_of_range_are_refused(option: Field[object]) -> None:
    low, high = option.metadata["range"]
    LocalizeOptions(**{option.name: low})
    LocalizeOptions(**{option.name: high})
    for outside in (low - 0.01, high + 1):
        with pytest.raises(InvalidInput):
            LocalizeOptions(**{option.name: outside})


def test_the_presets_are_those_of_the_code() -> None:
    listed = {
        words(name)[0]: tuple(float(number) for number in numbers)
        for name, *numbers, _ in table("preset")
    }

    assert listed == {
        name: (preset.max_error_px, preset.min_inliers, preset.min_inlier_ratio)
        for name, preset in PRESETS.items()
    }

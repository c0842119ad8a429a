from __future__ import annotations

import importlib.util
import json
import re
import shlex
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from clients import AsyncClient
from clients.cli.main import app, main
from clients.cli.options import Connection, Photos, QueryOptions
from clients.wire.answers import LocalizeResult
from tests.test_public_surface import modules_after
from visloc.errors import InvalidInput, Unavailable
from visloc.options import Extraction, Fusion, Matcher, Solver
from visloc.options import LocalizeOptions as CoreOptions
from visloc_api.words.maps import MapInfo
from visloc_api.words.options import LocalizeOptions
from visloc_extensions.research.cli import compare as compare_cli
from visloc_extensions.research.cli.compare_display import command_text, markdown_of
from visloc_extensions.research.cli.compare_plot import draw_comparison
from visloc_extensions.research.evaluation.compare import (
    DEFAULT_VALUES,
    Axis,
    make_variants,
    parse_values,
)

Dataset = Callable[..., Path]
PNG = b"\x89PNG\r\n\x1a\n"
TRUTH_WXYZ = [0.9298410554097046, 0.01755162593, 0.31931803130557, 0.1819987554486438]
TRUTH_TRANSLATION = [0.24164110554685916, 0.0, 1e-17]

ROOM = MapInfo(
    id="room",
    version="v1",
    created="2026-01-02T03:04:05Z",
    metric=True,
    method="rgbd",
    local_features="xfeat",
    global_features=("densevlad", "localvlad"),
    images=300,
    landmarks=7,
    observations=5,
    extent=((-1.0,), (1.0,)),
    size_bytes=2**20,
    down=None,
    rigs=(),
    anchor=None,
    place=None,
    current=True,
    versions=(),
    content_hash="ab",
)


def another(**changes: object) -> MapInfo:
    """The same map, but for some of its facts."""
    return ROOM.model_copy(update=changes)


def compare(*arguments: object) -> int:
    """Run ``localize compare`` and return its exit code."""
    with pytest.raises(SystemExit) as caught:
        main(["compare", *map(str, arguments)])
    code = caught.value.code
    return code if isinstance(code, int) else 0


def off_by(metres: float) -> bytes:
    """A photo that the canned service localizes this far from the truth, straight ahead."""
    translation = (np.array(TRUTH_TRANSLATION) - [0.0, 0.0, metres]).tolist()
    return json.dumps({"rotation_wxyz": TRUTH_WXYZ, "translation": translation}).encode()


def rows_of(folder: Path) -> list[list[str]]:
    """The cells of the table in compare.md, without the line below its head."""
    lines = (folder / "compare.md").read_text().splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("|")]
    return [rows[0], *rows[2:]]


# The values of an axis


def test_the_usual_values_are_all_words_of_the_server() -> None:
    enums = {
        Axis.FUSION: Fusion,
        Axis.MATCHER: Matcher,
        Axis.SOLVER: Solver,
        Axis.EXTRACTION: Extraction,
    }
    for axis, words in enums.items():
        assert DEFAULT_VALUES[axis] == tuple(words)
    assert DEFAULT_VALUES[Axis.TOP_K] == ("1", "5", "10", "20", "50")


def test_every_axis_but_the_map_varies_an_option_of_the_server() -> None:
    for axis in Axis:
        assert (axis.option is None) == (axis is Axis.LOCAL_FEATURES)
        assert axis.option is None or axis.option in CoreOptions.__slots__


def test_only_the_option_of_the_axis_varies() -> None:
    fixed = LocalizeOptions(top_k=7, seed=3)

    variants = make_variants(Axis.SOLVER, ["poselib", "pycolmap"], [ROOM], fixed)

    assert [variant.value for variant in variants] == ["poselib", "pycolmap"]
    assert [v.options for v in variants] == [
        fixed.model_copy(update={"solver": v.value}) for v in variants
    ]
    top_k = make_variants(Axis.TOP_K, (), [ROOM], LocalizeOptions())
    assert [variant.options.top_k for variant in top_k] == [1, 5, 10, 20, 50]


def test_global_features_are_compared_alone_then_all_together() -> None:
    def weights(values: Sequence[str], info: MapInfo = ROOM) -> dict[str, Any]:
        variants = make_variants(Axis.GLOBAL_FEATURES, values, [info], LocalizeOptions())
        return {variant.value: variant.options.fusion_weights for variant in variants}

    assert weights(()) == {
        "densevlad": {"densevlad": 1},
        "localvlad": {"localvlad": 1},
        "all": {"densevlad": 1, "localvlad": 1},
    }
    three = another(global_features=("densevlad", "localvlad", "gem"))
    assert weights(["localvlad+gem"], three) == {"localvlad+gem": {"localvlad": 1, "gem": 1}}
    assert weights((), another(global_features=("gem",))) == {"gem": {"gem": 1}}


def test_maps_are_named_by_their_local_features_as_far_as_these_differ() -> None:
    maps = [ROOM, another(id="b", local_features="sift"), another(id="c")]

    variants = make_variants(Axis.LOCAL_FEATURES, (), maps, LocalizeOptions())

    assert [v.value for v in variants] == ["xfeat (room@v1)", "sift", "xfeat (c@v1)"]
    assert [v.map for v in variants] == maps


@pytest.mark.parametrize(
    ("axis", "values", "maps", "options", "code"),
    [
        (Axis.FUSION, (), [ROOM, another(id="b")], {}, "compare.maps"),
        (Axis.LOCAL_FEATURES, (), [ROOM, ROOM], {}, "compare.maps"),
        (Axis.LOCAL_FEATURES, ("xfeat",), [ROOM], {}, "compare.values"),
        (Axis.FUSION, (), [ROOM], {"fusion": "mean"}, "compare.option"),
        (Axis.GLOBAL_FEATURES, (), [ROOM], {"fusion_weights": {"a": 1}}, "compare.option"),
        (Axis.TOP_K, ("many",), [ROOM], {}, "options.top_k"),
        (Axis.GLOBAL_FEATURES, ("densevlad+",), [ROOM], {}, "compare.values"),
        (Axis.GLOBAL_FEATURES, ("all", "densevlad+gem"), [ROOM], {}, "compare.values"),
        (Axis.FUSION, ("mean", "powr"), [ROOM], {}, "compare.values"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    axis: Axis,
    values: Sequence[str],
    maps: Sequence[MapInfo],
    options: dict[str, Any],
    code: str,
) -> None:
    with pytest.raises(InvalidInput) as caught:
        make_variants(axis, values, maps, LocalizeOptions(**options))
    assert caught.value.code == code


@pytest.mark.parametrize("text", ["", "a,", ",", "a,b,a"])
def test_values_are_different_words(text: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        parse_values(text)
    assert caught.value.code == "compare.values"
    assert parse_values(" a, b") == ("a", "b")


# A run


def test_the_table_holds_what_was_measured_below_a_command_that_can_be_pasted(
    url: str, make_dataset: Dataset, tmp_path: Path, service: Any, capsys: Any
) -> None:
    photos = {f"{i}.jpg": off_by(metres) for i, metres in enumerate((0.01, 0.04, 0.3))}
    dataset = make_dataset(photos | {"lost.jpg": b"refuse", "bad.jpg": b"broken"})
    arguments = [
        *(str(dataset), "--map", "room", "--axis", "fusion", "--values", "mean,gharm"),
        *("--output", str(tmp_path / "a folder"), "--server", url, "--option", "top_k=5"),
    ]

    assert compare(*arguments) == 0

    folder = tmp_path / "a folder"
    assert sorted(path.name for path in folder.iterdir()) == [
        f"compare.{kind}" for kind in ("json", "md", "png")
    ]
    assert (folder / "compare.png").read_bytes().startswith(PNG)
    head, *rows = rows_of(folder)
    assert head == [
        *("fusion", "localized", "0.05 m, 5°", "0.25 m, 2°", "0.5 m, 5°", "5 m, 10°"),
        *("median error", "p50", "p90", "map"),
    ]
    for row, value in zip(rows, ("mean", "gharm"), strict=True):
        assert row[:6] == [value, "3 of 5", "40.0%", "40.0%", "60.0%", "60.0%"]
        assert row[6] == "4.00 cm, 0.000°"
        assert all(re.fullmatch(r"\d+ ms", cell) for cell in row[7:9])
    text = (folder / "compare.md").read_text()
    command = text.removeprefix("```\n").partition("\n```")[0]
    assert shlex.split(command.replace("\\\n", "")) == ["localize", "compare", *arguments]
    assert "Photos without an answer: mean 1, gharm 1." in text
    assert "is not counted" in text
    figures = json.loads((folder / "compare.json").read_bytes())
    assert figures["command"] == command
    assert (figures["axis"], figures["photos"], figures["options"]) == ("fusion", 5, {"top_k": 5})
    assert [value["options"] for value in figures["values"]] == [
        {"top_k": 5, "fusion": "mean"},
        {"top_k": 5, "fusion": "gharm"},
    ]
    assert figures["values"][0]["figures"]["stage_seconds"]["features"] > 0
    printed = capsys.readouterr()
    assert "gharm" in printed.out
    assert "image.undecodable" in printed.err
    # One request of each value to warm up, then each photo with each.
    asked = Counter((seen["image"][:8], seen["options"]["fusion"]) for seen in service.seen)
    assert len(service.seen) == 2 + 5 * 2
    assert asked[b"broken", "mean"] == asked[b"refuse", "gharm"] == 1


def test_values_take_turns_in_an_order_that_the_seed_gives(
    http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any
) -> None:
    dataset = make_dataset({f"{i}.jpg": b"photo %d" % i for i in range(4)})
    orders = []
    for seed in (1, 1, 2):
        service.seen.clear()
        common = ("--map", "room", "--axis", "top-k", "--values", "1,2,3", "--seed", seed)
        code = compare(dataset, *common, "--output", tmp_path, "--server", http_url, "--repeat", 2)
        assert code == 0
        timed = [(s["image"], s["options"]["top_k"]) for s in service.seen[3:]]
        assert [image for image, _ in timed] == [b"photo %d" % (i // 6) for i in range(24)]
        turns = [tuple(top_k for _, top_k in timed[i : i + 3]) for i in range(0, 24, 3)]
        assert all(sorted(turn) == [1, 2, 3] for turn in turns)
        orders.append(turns)
    assert orders[0] == orders[1] != orders[2]
    assert len(set(orders[0])) > 1
    figures = json.loads((tmp_path / "compare.json").read_bytes())
    assert (figures["repeats"], figures["seed"]) == (2, 2)


def test_the_first_request_of_a_value_is_not_timed(
    http_url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    service: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answer = type(service).localize
    cold: set[str] = set()

    def localize(self: Any, image: bytes, asked: dict[str, Any], *rest: Any) -> Any:
        solver = asked["options"]["solver"]
        if solver not in cold:
            cold.add(solver)
            time.sleep(0.5)
        return answer(self, image, asked, *rest)

    monkeypatch.setattr(type(service), "localize", localize)
    arguments = ("--map", "room", "--axis", "solver", "--output", tmp_path, "--server", http_url)

    assert compare(make_dataset({"a": b"photo", "b": b"photo"}), *arguments) == 0

    values = json.loads((tmp_path / "compare.json").read_bytes())["values"]
    assert cold == set(Solver)
    assert max(value["figures"]["latency_s"]["p99"] for value in values) < 0.4


def refusing(
    service: Any, monkeypatch: pytest.MonkeyPatch, error: Exception, word: str, after: int = 0
) -> None:
    """Make the canned service refuse a matcher, some time later."""
    answer = type(service).localize
    seen: Counter[str] = Counter()

    def localize(self: Any, image: bytes, asked: dict[str, Any], *rest: Any) -> Any:
        matcher = asked["options"]["matcher"]
        seen[matcher] += 1
        if matcher == word and seen[matcher] > after:
            raise error
        return answer(self, image, asked, *rest)

    monkeypatch.setattr(type(service), "localize", localize)


@pytest.mark.parametrize("after", [0, 2])
def test_a_value_that_the_server_refuses_is_a_row_that_says_so(
    after: int,
    url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    service: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    error = InvalidInput("options.matcher", "no network for | sift", field="options.matcher")
    refusing(service, monkeypatch, error, "lightglue", after)
    dataset = make_dataset({f"{i}.jpg": b"photo" for i in range(3)})
    arguments = ("--map", "room", "--axis", "matcher", "--output", tmp_path, "--server", url)

    assert compare(dataset, *arguments) == 0

    _, mutual, ratio, lightglue = rows_of(tmp_path)
    assert mutual[1] == ratio[1] == "3 of 3"
    assert lightglue[:3] == ["lightglue", "refused: options.matcher", "-"]
    text = (tmp_path / "compare.md").read_text()
    assert "Refused: lightglue: [options.matcher]" in text
    values = json.loads((tmp_path / "compare.json").read_bytes())["values"]
    assert [value["figures"] is None for value in values] == [False, False, True]
    assert values[2]["refusal"]["code"] == "options.matcher"
    assert "no network" in capsys.readouterr().out


def test_when_all_values_are_refused_that_is_an_error(
    http_url: str, make_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--map", "room", "--axis", "top-k", "--output", tmp_path, "--server", http_url)

    assert compare(make_dataset({"a": b"preset"}), *arguments) == 1

    assert "options.preset" in capsys.readouterr().err
    assert not list(tmp_path.glob("compare.*"))


def test_a_server_that_is_gone_is_an_error_and_nothing_is_written(
    http_url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    num_asked = 0

    async def localize(self: AsyncClient, *arguments: Any) -> LocalizeResult:
        nonlocal num_asked
        num_asked += 1
        if num_asked > 7:
            raise Unavailable("server.unreachable", "no server")
        return await answer(self, *arguments)

    answer = AsyncClient.localize
    monkeypatch.setattr(AsyncClient, "localize", localize)
    arguments = ("--map", "room", "--axis", "top-k", "--output", tmp_path, "--server", http_url)

    assert compare(make_dataset({"a": b"photo", "b": b"photo"}), *arguments) == 1
    error = capsys.readouterr().err
    assert "nothing was written" in error
    assert "server.unreachable" in error
    assert not list(tmp_path.glob("*compare*"))


def test_ctrl_c_leaves_nothing_half_written(
    http_url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(compare_cli, "ask_each", stopped)
    output = tmp_path / "output"
    arguments = ("--map", "room", "--axis", "top-k", "--output", output, "--server", http_url)

    assert compare(make_dataset({"a": b"photo"}), *arguments) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert list(output.iterdir()) == []


def test_without_matplotlib_nothing_is_asked(
    http_url: str,
    make_dataset: Dataset,
    tmp_path: Path,
    service: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    arguments = ("--map", "room", "--axis", "top-k", "--output", tmp_path, "--server", http_url)

    assert compare(make_dataset({"a": b"photo"}), *arguments) == 1
    assert "pip install matplotlib" in capsys.readouterr().err
    assert service.seen == []


def test_without_true_poses_there_is_no_accuracy_but_time(
    http_url: str, make_dataset: Dataset, tmp_path: Path
) -> None:
    dataset = make_dataset({"a": b"photo", "b": b"refuse"}, truth=False)
    arguments = ("--map", "room", "--axis", "solver", "--output", tmp_path, "--server", http_url)

    assert compare(dataset, *arguments) == 0

    head, *rows = rows_of(tmp_path)
    assert head == ["solver", "localized", "median error", "p50", "p90", "map"]
    assert [row[1:3] for row in rows] == [["1 of 2", "-"]] * 3
    assert "none with a known pose" in (tmp_path / "compare.md").read_text()


def test_several_maps_for_another_axis_are_refused_before_any_photo_is_asked_about(
    http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any, capsys: Any
) -> None:
    maps = ("--map", "room", "--map", "room@v1")
    arguments = ("--axis", "fusion", "--output", tmp_path, "--server", http_url)

    assert compare(make_dataset({"a": b"photo"}), *maps, *arguments) == 1
    assert "compare.maps" in capsys.readouterr().err
    assert service.seen == []


@pytest.mark.parametrize("values", ["mean,powr", "mean"])
def test_a_refusal_leaves_no_folder_and_a_file_in_its_way_is_named(
    values: str, http_url: str, make_dataset: Dataset, tmp_path: Path, service: Any, capsys: Any
) -> None:
    (tmp_path / "file").write_text("mine")
    output = tmp_path / ("new" if "powr" in values else "file")
    common = ("--map", "room", "--axis", "fusion", "--server", http_url, "--output", output)

    assert compare(make_dataset({"a": b"photo"}), *common, "--values", values) == 1

    code = "compare.values" if "powr" in values else "output.folder"
    assert capsys.readouterr().err.startswith(f"error [{code}] ")
    assert not (tmp_path / "new").exists()
    assert service.seen == []


# What is written


def comparison(num_values: int = 3, **changes: Any) -> dict[str, Any]:
    """A comparison as ``make_comparison`` gives it; its last value is refused."""
    figures = {
        "localized": 9,
        "recall": [{"fraction": 0.5}, {"fraction": 1.0}],
        "median_position_error_m": 0.0123,
        "median_orientation_error_deg": 0.5,
        "latency_s": {"p50": 0.05, "p90": 0.08, "p99": 0.1},
    }
    values = [
        {
            **{"value": f"value{i}", "map": "room@v1", "local_features": "xfeat"},
            **{"global_features": ["densevlad"], "size_bytes": 2**20, "errors": 0},
            **{"refusal": None, "figures": figures},
        }
        for i in range(num_values)
    ]
    values[-1] |= {"figures": None, "refusal": {"code": "options.fusion", "message": "no"}}
    return {
        **{"axis": "fusion", "command": "localize compare", "server": {"version": None}},
        **{"photos": 10, "photos_with_truth": 10, "metric": True, "repeats": 1, "seed": 0},
        **{"thresholds": [[0.05, 5.0], [0.25, 2.0]], "values": values, **changes},
    }


@pytest.mark.parametrize("num_values", [1, 2, 10])
def test_a_picture_of_any_number_of_values_is_drawn(num_values: int) -> None:
    assert draw_comparison(comparison(num_values)).startswith(PNG)


def test_odd_names_break_neither_the_table_nor_the_picture() -> None:
    odd = comparison(2)
    odd["values"][0] |= {"value": "a|$b_{$\n\x1b[31m", "local_features": "$\\frac{"}

    assert draw_comparison(odd).startswith(PNG)
    rows = [line for line in markdown_of(odd, "p.png").splitlines() if line.startswith("|")]
    assert len(rows) == 4
    assert rows[2].startswith(r"| a\|$b_{$??[31m | 9 of 10 | 50.0% |")


def test_a_world_of_unknown_scale_has_no_centimetres() -> None:
    text = markdown_of(comparison(metric=False), "p.png")

    assert "| 0.05 units, 5° |" in text
    assert "| 0.0123 units, 0.500° |" in text
    assert " cm" not in text


def test_nothing_localized_has_no_median_and_no_time_is_made_up() -> None:
    empty = comparison(1)
    empty["values"][0] |= {
        "refusal": None,
        "figures": {
            "localized": 0,
            "recall": [{"fraction": 0.0}] * 2,
            "median_position_error_m": None,
            "median_orientation_error_deg": None,
            "latency_s": {"p50": None, "p90": None, "p99": None},
        },
    }

    assert "| 0 of 10 | 0.0% | 0.0% | - | - | - |" in markdown_of(empty, "p.png")
    assert draw_comparison(empty).startswith(PNG)


def test_a_long_command_is_broken_before_options() -> None:
    arguments = ["compare", "a b", *(w for i in range(20) for w in (f"--option{i}", "value's"))]

    text = command_text(arguments)

    assert text.count(" \\\n") > 1
    assert all(len(line) < 110 for line in text.splitlines())
    assert shlex.split(text.replace("\\\n", "")) == ["localize", *arguments]


def test_the_usual_values_of_an_axis_are_compared(
    doors: tuple[str, str], sample: Path, tmp_path: Path
) -> None:
    rows = {}
    for axis, values in (("fusion", "gharm,max"), ("solver", None), ("global-features", None)):
        output = tmp_path / axis
        arguments = ["compare", str(sample / "query"), "--map", "room", "--axis", axis]
        arguments += ["--output", str(output), "--server", doors[1], "--option", "matcher=ratio"]
        with pytest.raises(SystemExit) as caught:
            main([*arguments, *(() if values is None else ("--values", values))])
        assert caught.value.code in (0, None)
        rows[axis] = json.loads((output / "compare.json").read_bytes())["values"]
    assert {axis: [row["value"] for row in found] for axis, found in rows.items()} == {
        "fusion": ["gharm", "max"],
        "solver": ["pycolmap", "poselib", "registration"],
        "global-features": ["densevlad", "localvlad", "all"],
    }
    for row in (row for found in rows.values() for row in found):
        assert row["refusal"] is None, row
        assert row["figures"]["localized"] == 3
        assert row["figures"]["recall"][0]["fraction"] == 1.0
        assert row["size_bytes"] > 0


def test_a_matcher_that_the_features_have_none_of_is_a_row_that_says_so(
    doors: tuple[str, str], sample: Path, tmp_path: Path
) -> None:
    arguments = ["compare", str(sample / "query"), "--map", "room", "--axis", "matcher"]
    with pytest.raises(SystemExit) as caught:
        main([*arguments, "--output", str(tmp_path), "--server", doors[0]])

    assert caught.value.code in (0, None)
    values = json.loads((tmp_path / "compare.json").read_bytes())["values"]
    assert [value["refusal"] is None for value in values] == [True, True, False]
    assert values[2]["refusal"]["code"].startswith(("options.", "features.", "weights."))


def test_compare_has_all_options_of_the_connection_the_query_and_the_photos() -> None:
    command: Any = typer.main.get_command(app)
    names = [parameter.name for parameter in command.commands["compare"].params]
    assert {each.name for kind in (Connection, QueryOptions, Photos) for each in fields(kind)} <= {
        *names
    }
    assert len(set(names)) == len(names)


def test_the_commands_that_ask_a_server_load_nothing_heavy() -> None:
    names = (
        f"visloc_extensions.research.cli.{name}" for name in ("compare", "evaluate", "retrieve")
    )
    loaded = modules_after(f"import {', '.join(names)}")
    assert not loaded & {"torch", "cv2", "pycolmap", "PIL", "scipy", "safetensors"}

"""Tables of docs/results.md that ``make results`` writes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import benchmarks.results.__main__ as command
from benchmarks.results.page import Measured, joined_rows, names_in, with_table
from benchmarks.results.tables import MAPS, TABLES, Table

ROOT = Path(__file__).parents[2]
PAGE = """# Results

<!-- table one -->

Measured long ago.

| a | b |
|---|---|
| 1 | 2 |

Words about it.

<!-- table two -->

No rows yet.

## Next

| c |
|---|
| 3 |
"""
NEW = Measured("abc1234", "2026-11-23", ["| a | b |", "|---|---|", "| 5 | 6 |"])


def test_the_page_has_each_table_once_and_no_other() -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert sorted(names_in(page)) == sorted(TABLES)
    assert {each for table in TABLES.values() for each in table.maps} == set(MAPS)


def test_a_table_is_replaced_with_its_stamp_and_nothing_else_is() -> None:
    stamped = "Measured on 2026-11-23 at commit abc1234.\n\n| a | b |\n|---|---|\n| 5 | 6 |\n"
    once = with_table(PAGE, "one", NEW)
    assert once == PAGE.replace("Measured long ago.\n\n| a | b |\n|---|---|\n| 1 | 2 |\n", stamped)
    assert with_table(once, "one", NEW) == once
    # Before there is a table, that of the next section is not taken for it.
    both = with_table(once, "two", NEW)
    assert both == once.replace("No rows yet.\n\n", stamped)
    with pytest.raises(KeyError):
        with_table(PAGE, "three", NEW)


def test_runs_are_joined_under_one_header() -> None:
    output = "noise\n| a |\n|---|\n| {} |\n\n0.2 s more"
    assert joined_rows([("", output.format(1))]) == ["| a |", "|---|", "| 1 |"]
    outputs = [("left", output.format(1)), ("right", output.format(2))]
    assert joined_rows(outputs) == ["|  | a |", "|---|---|", "| left | 1 |", "| right | 2 |"]
    with pytest.raises(ValueError, match="right"):
        joined_rows([*outputs[:1], ("right", "| b |\n|---|\n| 2 |")])
    with pytest.raises(ValueError, match="no table"):
        joined_rows([("", "nothing")])


@pytest.mark.parametrize(
    ("script", "why"), [("raise SystemExit(3)", "exit status 3"), ("print('none')", "no table")]
)
def test_a_table_that_cannot_be_measured_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, why: str
) -> None:
    monkeypatch.setattr(command, "TABLES", {"one": Table({"": ("-c", script)})})
    with pytest.raises(SystemExit, match=f"table one was not measured: .*{why}"):
        command.main(["one"], tmp_path / "data", tmp_path / "work", measure_only=True)
    assert not list((tmp_path / "work").rglob("*.json"))


def test_what_was_measured_is_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "script.py"
    counted = tmp_path / "runs"
    script.write_text(
        "import sys, pathlib\n"
        f"pathlib.Path({str(counted)!r}).open('a').write('x')\n"
        "print('| of |\\n|---|\\n| ' + sys.argv[1] + ' |')\n"
    )
    table = Table({"": (str(script), "DATA/castle")})
    monkeypatch.setattr(command, "TABLES", {"one": table})
    monkeypatch.setattr(command, "commit_of", lambda _: "abc1234")
    for _ in range(2):
        command.main(["one"], tmp_path / "data", tmp_path / "work", measure_only=True)
    shown = capsys.readouterr().out
    assert shown.count(f"| {tmp_path / 'data'}/castle |") == 2
    assert counted.read_text() == "x"
    measured = json.loads((tmp_path / "work" / "abc1234" / "one.json").read_text())
    assert measured["commit"] == "abc1234"
    monkeypatch.setattr(command, "commit_of", lambda _: "abc1234+")  # files may have changed
    for _ in range(2):
        command.main(["one"], tmp_path / "data", tmp_path / "work", measure_only=True)
    assert counted.read_text() == "xxx"

from __future__ import annotations

import io
import threading
from collections.abc import Callable

import pytest
from rich.console import Console

from mapping.cli import progress
from mapping.cli.progress import StageProgress
from mapping.progress import one_step


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Console:
    """A console that is no terminal, with a line every few milliseconds."""
    monkeypatch.setattr(progress, "_LINE_EVERY_S", 0.005)
    return Console(file=io.StringIO(), width=200)


def lines_of(console: Console) -> list[str]:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


def wait_for(console: Console, is_there: Callable[[str], bool]) -> None:
    waiting = threading.Event()
    for _ in range(2000):
        if any(map(is_there, lines_of(console))):
            return
        waiting.wait(0.005)
    raise AssertionError(lines_of(console))


def test_a_log_gets_lines_while_a_single_step_is_under_way(log: Console) -> None:
    with StageProgress(log) as told, one_step(told, "triangulation"):
        wait_for(log, lambda line: line.startswith("triangulation: 0/1 after "))
    assert lines_of(log)[-1].startswith("triangulation: 1/1 in ")


def test_a_log_tells_how_far_a_stage_is_and_how_long_it_will_take(log: Console) -> None:
    with StageProgress(log) as told:
        told("photos", 0, 1000)
        for done in range(1, 6):
            told("photos", done, 1000)
            threading.Event().wait(0.01)
        wait_for(log, lambda line: line.startswith("photos: 5/1000 after ") and " s left" in line)


def test_nothing_is_told_between_stages_and_after_the_end(log: Console) -> None:
    with StageProgress(log) as told:
        told("photos", 0, 2)
        told("photos", 2, 2)
        count = len(lines_of(log))
        threading.Event().wait(0.05)
        assert len(lines_of(log)) == count
    assert not [thread for thread in threading.enumerate() if thread.name == "progress"]


def test_a_short_step_takes_no_line_in_a_log() -> None:
    console = Console(file=io.StringIO(), width=200)
    with StageProgress(console) as told, one_step(told, "pairs"):
        pass
    assert lines_of(console) == []


def test_a_terminal_shows_a_bar_that_moves() -> None:
    console = Console(file=io.StringIO(), width=120, force_terminal=True)
    with StageProgress(console) as told, one_step(told, "triangulation"):
        wait_for(console, lambda line: "triangulation" in line and "0/1" in line)


def test_a_stage_that_is_done_once_more_is_told_again(log: Console) -> None:
    with StageProgress(log) as told:
        told("matches", 10, 10)
        told("matches", 0, 10)
        wait_for(log, lambda line: line.startswith("matches: 0/10 after "))
        told("matches", 10, 10)
    assert sum(line.startswith("matches: 10/10 in ") for line in lines_of(log)) == 2

"""What counts as seen by a query, in scenes whose answer is known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer

from benchmarks.retrieval import (
    Query,
    chosen,
    main,
    recalls,
    shared_landmarks,
    visible_landmarks,
    whole_numbers,
)
from visloc.archive.schema import Parts
from visloc.geometry import Camera, Pose
from visloc.retrieval.fusion import EQUAL_GHARM
from visloc.retrieval.index import GlobalRows

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
HERE = Pose.identity()


def visible(points: list[list[float]]) -> list[bool]:
    return visible_landmarks(np.array(points), CAMERA, HERE).tolist()


def test_only_what_projects_into_the_image_from_in_front_is_visible() -> None:
    points = [[0.0, 0, 5], [0, 0, -5], [3.19, 0, 5], [3.21, 0, 5], [0, 2.39, 5], [0, -2.41, 5]]
    assert visible(points) == [True, False, True, False, True, False]


@pytest.mark.parametrize(
    ("hiding", "depth", "seen"), [(3, 3.9, False), (2, 3.9, True), (3, 4.1, True)]
)
def test_three_landmarks_that_are_clearly_nearer_hide_one(
    hiding: int, depth: float, seen: bool
) -> None:
    assert visible([[0.01, 0.01, 5.0], *[[0.01, 0.01, depth]] * hiding])[0] is seen
    assert all(visible([[0.01, 0.01, 5.0], *[[0.01, 0.01, depth]] * hiding])[1:])
    # In another cell nothing is hidden.
    assert visible([[1.0, 0.01, 5.0], *[[0.01, 0.01, depth]] * hiding])[0]


def looking_from(center: list[float]) -> list[float]:
    return [1.0, 0, 0, 0, *(-np.array(center)).tolist()]


def test_landmarks_are_shared_within_an_angle_and_a_ratio_of_distances() -> None:
    origin = np.array([1e6, 2e6, 50.0])
    point = np.array([[0.0, 0.0, 10.0]])
    centers = [
        *([0.0, 0, 0], [0, 0, 4.9], [0, 0, 5.1], [0, 0, -9.9], [0, 0, -10.1]),
        *(
            [16.0, 0, 10.0 - 16 / np.tan(np.radians(61))],
            [16.0, 0, 10 - 16 / np.tan(np.radians(59))],
        ),
    ]
    opened: Any = SimpleNamespace(
        manifest=SimpleNamespace(world=SimpleNamespace(origin=tuple(origin)), parts=Parts()),
        landmarks=point.astype(np.float32),
        images=centers,
        image_poses=np.array([looking_from(list(np.array(c) + origin)) for c in centers]),
        observations=lambda _: (np.array([0, 0], np.uint32), None),
    )
    shared = shared_landmarks(opened, CAMERA, Pose(np.eye(3), -origin))
    assert shared.tolist() == [1, 1, 0, 1, 0, 0, 1]


def test_recall_is_of_the_best_k_and_of_what_was_possible() -> None:
    angles = np.radians([0.0, 10, 20, 30])
    rows = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    opened: Any = SimpleNamespace(global_descriptors={"a": GlobalRows(rows)}, images=[None] * 4)
    asked = [
        Query({"a": rows[0]}, np.array([True, False, True, False])),
        Query({"a": rows[3]}, np.array([True, False, False, False])),
    ]
    assert recalls(asked, opened, EQUAL_GHARM, [1, 3, 50]) == [
        pytest.approx((0.5, 0.5)),
        pytest.approx(((2 / 3 + 0) / 2, 0.5)),
        pytest.approx(((2 / 4 + 1 / 4) / 2, 1.0)),
    ]


def test_global_features_are_chosen_by_name() -> None:
    known = ["densevlad", "localvlad", "gem"]
    assert chosen(None, known) == known
    assert chosen("gem,densevlad,gem", known) == ["gem", "densevlad"]


@pytest.mark.parametrize("unknown", ["netvlad", ""])
def test_unknown_global_features_are_refused_with_those_of_the_map(unknown: str) -> None:
    with pytest.raises(typer.BadParameter, match="only densevlad, localvlad"):
        chosen(f"densevlad,{unknown}", ["densevlad", "localvlad"])


def test_ready_made_descriptors_are_refused_because_no_query_has_them() -> None:
    known = ["densevlad", "kapture:AP-GeM"]
    with pytest.raises(typer.BadParameter, match="kapture:AP-GeM cannot be measured"):
        chosen(None, known)
    assert chosen("densevlad", known) == ["densevlad"]


@pytest.mark.parametrize("text", ["", "0", "5,-1", "5,x"])
def test_ranks_are_counted_from_one(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="not numbers from 1"):
        whole_numbers(text)
    assert whole_numbers("1, 20") == [1, 20]


def test_the_command_measures_a_map(
    sample: Path, built_maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(built_maps / "room", sample / "query", top_k="1,8")

    said, _, table = capsys.readouterr().out.partition("\n\n")
    assert said.startswith("3 of 3 queries share 30 landmarks or more")
    rows = [line.strip("|").split("|") for line in table.splitlines()]
    assert rows[0] == [" retrieval by ", " top 1 ", " top 8 "]
    assert {len(row) for row in rows} == {3}
    assert [row[0].strip() for row in rows[2:4]] == ["`densevlad`", "`localvlad`"]
    # Of all photos of the map, no ranking misses one.
    assert all(row[2].endswith("(100.0) ") for row in rows[2:])

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
import pytest

from tools.supply_chain.licences import (
    PAGE,
    Licensed,
    dependencies,
    is_allowed,
    page,
    policy,
    refusals,
)

RULES = policy()
FOUND = dependencies(RULES)


def test_the_policy_allows_all_that_is_needed() -> None:
    assert refusals(FOUND, RULES) == []


def test_the_page_lists_them() -> None:
    assert PAGE.read_text() == page(FOUND, RULES)
    assert {"torch", "numpy", "fastapi", "pytest"} <= {one.name for one in FOUND}


def test_no_image_holds_more_of_the_gpl_than_the_policy_says() -> None:
    shipped = [one for one in FOUND if one.images]

    assert not [one.name for one in shipped if "GPL" in one.licence.replace("LGPL", "")]
    assert {one.name: one.images for one in shipped if one.bundled} == {
        "av": ("mapping",),
        "pycolmap": ("service", "mapping"),
    }


def test_what_is_linked_into_a_wheel_is_there() -> None:
    (code,) = (Path(pycolmap.__file__).parent).glob("_core*.so")
    content = code.read_bytes()
    for module in (b"Supernodal", b"MatrixOps"):
        assert b"/CHOLMOD/%s/" % module in content


def dependency(
    licence: str, images: tuple[str, ...] = (), bundled: tuple[str, ...] = ()
) -> Licensed:
    return Licensed("new", "1", licence, images, bundled)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (dependency("AGPL-3.0-only"), "new 1: AGPL-3.0-only"),
        (dependency(""), "new 1: no licence is told"),
        (dependency("MIT AND GPL-2.0-only"), "new 1: MIT AND GPL-2.0-only"),
        (dependency("MIT", (), ("libx264 (GPL-2.0-or-later)",)), "new 1 holds libx264"),
    ],
)
def test_what_the_policy_does_not_allow_is_told(found: Licensed, expected: str) -> None:
    told = refusals([*FOUND, found], RULES)
    assert len(told) == 1
    assert told[0].startswith(expected)


def test_a_tool_that_is_an_exception_must_not_come_into_an_image() -> None:
    rules: dict[str, Any] = copy.deepcopy(RULES)
    rules["tools"]["new"] = "a test runs it"

    assert refusals([*FOUND, dependency("GPL-2.0-only")], rules) == []
    assert refusals([*FOUND, dependency("GPL-2.0-only", ("service",))], rules) != []


def test_an_exception_that_nothing_needs_is_told() -> None:
    assert refusals([one for one in FOUND if one.name != "av"], RULES) == [
        "av: the policy knows it, and nothing needs it"
    ]


def test_one_of_several_licences_may_be_chosen_and_all_parts_must_be_allowed() -> None:
    allowed = ("MIT", "Apache-2.0")
    assert is_allowed("MIT", allowed)
    assert is_allowed("GPL-2.0-only OR Apache-2.0 AND MIT", allowed)
    assert not is_allowed("MIT AND GPL-2.0-only", allowed)

from __future__ import annotations

from collections.abc import Iterator

import pytest

from service.api.deadlines import request_id
from service.errors import STATUSES, statuses_of
from visloc.errors import Overloaded, TooLarge, VislocError


def kinds(root: type[VislocError] = VislocError) -> Iterator[type[VislocError]]:
    yield root
    for kind in root.__subclasses__():
        yield from kinds(kind)


def test_every_kind_of_error_has_a_status_on_both_doors() -> None:
    missing = [
        kind.__name__
        for kind in kinds()
        if kind.__module__ == "visloc.errors" and kind not in STATUSES
    ]

    assert missing == [], "give it a line in service/errors.py"


def test_a_kind_from_elsewhere_has_the_status_of_its_parent() -> None:
    class TooWide(TooLarge):
        pass

    assert statuses_of(TooWide("x", "x")) == STATUSES[TooLarge]
    assert statuses_of(Overloaded("x", "x"))[0] == 429


@pytest.mark.parametrize("given", ["a", "7f3c-22", "job/12:3", "x" * 128])
def test_a_short_visible_request_id_is_kept(given: str) -> None:
    assert request_id(given) == given


@pytest.mark.parametrize("given", [None, "", "two words", "line\nbreak", "x" * 129, "é", "\x00"])
def test_any_other_request_id_is_replaced(given: str | None) -> None:
    made = request_id(given)

    assert made != given
    assert len(made) == 32
    assert made != request_id(given)

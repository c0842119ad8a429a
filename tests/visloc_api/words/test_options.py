from __future__ import annotations

from collections.abc import Mapping
from typing import get_args, get_origin

import pytest

from visloc.options import Solver
from visloc_api.words import options


def test_words_have_the_options_of_the_core() -> None:
    for name, kind in options.KINDS.items():
        field = options.LocalizeOptions.model_fields[name]
        (hint,) = (each for each in get_args(field.annotation) if each is not type(None))
        said = get_origin(hint) or hint
        assert issubclass(kind, said) or (kind, said) in ((Mapping, dict), (tuple, list))
    assert list(options.LocalizeOptions.model_fields) == list(options.KINDS)


@pytest.mark.parametrize("name", options.KINDS)
def test_every_option_is_described(name: str) -> None:
    text = options.describe(name)
    assert "; by default " in text
    assert all(choice in text for choice in options.CHOICES.get(name, ()))


def test_the_schema_lists_words_bounds_and_defaults() -> None:
    schema = options.LocalizeOptions.model_json_schema()["properties"]
    assert schema["solver"]["enum"] == [*Solver, None]
    assert schema["solver"]["default"] == "pycolmap"
    assert schema["fusion"]["default"] is None  # the map's
    top_k = schema["top_k"]
    assert (top_k["minimum"], top_k["maximum"], top_k["default"]) == (1, 1000, 20)
    assert all(option["title"] for option in schema.values())


def test_a_solver_is_named_in_one_place() -> None:
    assert options.CHOICES["solver"] == tuple(solver.value for solver in Solver)

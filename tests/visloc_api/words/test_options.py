from __future__ import annotations

from dataclasses import fields

import pytest

import clients
from visloc.options import LocalizeOptions, Solver
from visloc_api.words import options


def test_words_and_clients_have_the_options_of_the_core() -> None:
    names = [option.name for option in fields(LocalizeOptions)]
    assert list(options.LocalizeOptions.model_fields) == names
    assert [option.name for option in fields(clients.LocalizeOptions)] == names


@pytest.mark.parametrize("name", options.KINDS)
def test_every_option_is_described(name: str) -> None:
    text = options.describe(name)
    assert "; by default " in text
    assert all(choice in text for choice in options.CHOICES.get(name, ()))


def test_a_solver_is_named_in_one_place() -> None:
    assert options.CHOICES["solver"] == tuple(solver.value for solver in Solver)

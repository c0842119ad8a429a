"""The command line is made of the options themselves."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from clients.cli.main import app
from clients.cli.options import Connection, Photos, QueryOptions, spread
from visloc.options import LocalizeOptions as KnownOptions
from visloc.options import Matcher, Solver


@dataclass(frozen=True, kw_only=True)
class Shared:
    name: Annotated[str, typer.Argument()]
    times: Annotated[int, typer.Option("--repeat", min=1)] = 2


@dataclass(frozen=True, kw_only=True)
class More(Shared):
    is_loud: bool = False


def test_each_field_of_a_class_is_an_option_of_the_command() -> None:
    greeting = typer.Typer()

    @greeting.command()
    @spread
    def greet(*, word: str = "hello", more: More) -> None:
        """Say a word."""
        text = " ".join([word] * more.times + [more.name])
        typer.echo(text.upper() if more.is_loud else text)

    def run(*arguments: str) -> str:
        return CliRunner().invoke(greeting, arguments).output.strip()

    assert run("you") == "hello hello you"
    assert run("you", "--repeat", "1", "--is-loud", "--word", "hi") == "HI YOU"
    assert "greater than or equal to 1" in run("you", "--repeat", "0")
    assert greet.__doc__ == "Say a word."


def commands() -> dict[str, Any]:
    command: Any = typer.main.get_command(app)
    return {**command.commands, **command.commands["maps"].commands}


@pytest.mark.parametrize("name", ["image", "batch", "benchmark", "list", "push", "use"])
def test_every_command_that_asks_a_server_has_all_options_of_the_connection(name: str) -> None:
    names = [parameter.name for parameter in commands()[name].params]

    assert {each.name for each in fields(Connection)} <= set(names)
    if name in ("image", "batch", "benchmark"):
        assert {each.name for each in fields(QueryOptions)} <= set(names)
    if name in ("batch", "benchmark"):
        assert {each.name for each in fields(Photos)} <= set(names)
    assert len(set(names)) == len(names)


def test_the_help_names_every_option_of_a_query_and_its_words() -> None:
    (option,) = (each for each in commands()["image"].params if each.name == "option")

    assert option.help.startswith("Can be repeated. Names: preset (default, config1, config2); ")
    for each in fields(KnownOptions):
        assert (
            f"{each.name};" in option.help
            or f"{each.name} (" in option.help
            or (f"{each.name}." in option.help)
        )
    assert f"solver ({', '.join(Solver)})" in option.help
    assert f"matcher ({', '.join(Matcher)})" in option.help

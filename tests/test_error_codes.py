"""Every error that the code makes is in ``visloc/error_codes.toml``, and nothing else is."""

from __future__ import annotations

import ast
import copy
import pickle
import string
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from visloc import errors
from visloc.errors import InvalidInput, VislocError, catalogue, refuse

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    *("visloc", "visloc_api", "mapping", "service", "clients", "training", "benchmarks"),
    "visloc_extensions",
)
KINDS = {
    name
    for name, value in vars(errors).items()
    if isinstance(value, type) and issubclass(value, VislocError)
}
RESERVED = {"field", "expected", "got", "kind"}
TREES = {
    str(path.relative_to(ROOT)): ast.parse(path.read_text())
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
    if path.parent.name != "tests"
}
CORE = ("api", "clients", "commands", "training")  # sections; others name an extension

# Reading


@dataclass(frozen=True)
class Use:
    """A code that is given to ``refuse``, or to a helper that takes one."""

    place: str
    call: ast.Call
    code: ast.expr
    of_refuse: bool


def name_of(call: ast.Call) -> str:
    function = call.func
    return getattr(function, "id", None) or getattr(function, "attr", "")


def parameters(node: ast.AST) -> list[str]:
    """The parameters of a function or of a dataclass, as callers count them."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        names = [each.arg for each in (*node.args.posonlyargs, *node.args.args)]
        return [
            *(n for n in names if n not in ("self", "cls")),
            *(a.arg for a in node.args.kwonlyargs),
        ]
    if isinstance(node, ast.ClassDef):
        return [
            each.target.id
            for each in node.body
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
        ]
    return []


def takers_of_codes() -> dict[str, set[tuple[int, str]]]:
    """By name of a function or class: which of its parameters is the code of an error."""
    found = defaultdict(set)
    for tree in TREES.values():
        for node in ast.walk(tree):
            for index, name in enumerate(parameters(node)):
                if name == "code" or name.endswith("_code"):
                    found[node.name].add((index, name))  # type: ignore[attr-defined]
    return found


def uses() -> Iterator[Use]:
    takers = takers_of_codes()
    for place, tree in TREES.items():
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            for index, name in takers.get(name_of(call), ()):
                given = [k.value for k in call.keywords if k.arg == name] or call.args[index:][:1]
                for code in given:
                    where = f"{place}:{call.lineno}"
                    yield Use(where, call, code, name_of(call) == "refuse")


def keys_of(code: ast.expr, tree: ast.Module) -> list[str]:
    """The entries of the catalogue that an expression stands for; none for a variable."""
    match code:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.JoinedStr(values=[ast.Constant(value=str(text)), *_]) if "." in text:
            return [text.partition(".")[0] + ".*"]
        case ast.IfExp(body=body, orelse=other):
            return [*keys_of(body, tree), *keys_of(other, tree)]
        case ast.Name(id=name):
            constants = (n for n in tree.body if isinstance(n, ast.Assign))
            return [
                key
                for constant in constants
                if ast.unparse(constant.targets[0]) == name
                for key in keys_of(constant.value, tree)
            ]
    return []


def keys_in(use: Use) -> list[str]:
    return keys_of(use.code, TREES[use.place.partition(":")[0]])


def strings() -> set[str]:
    """Every text of the sources; a ``field=`` names fields, which look like codes."""
    found: set[str] = set()

    def collect(node: ast.AST) -> None:
        match node:
            case ast.keyword(arg="field"):
                return
            case ast.Constant(value=str(text)):
                found.add(text)
        for child in ast.iter_child_nodes(node):
            collect(child)

    for tree in TREES.values():
        collect(tree)
    return found


USES = [use for use in uses() if keys_in(use)]

# The catalogue and the code


def test_every_code_that_is_used_is_listed() -> None:
    unknown = {
        key: use.place
        for use in USES
        for key in keys_in(use)
        if key not in catalogue() and ("." in key or use.of_refuse)
    }

    assert not unknown
    assert len(USES) > 400


def test_every_code_that_is_listed_is_used() -> None:
    used = strings() | {key for use in USES for key in keys_in(use)}

    here = {*CORE, *(each.parent.name for each in ROOT.glob("visloc_extensions/*/__init__.py"))}
    assert {code for code, entry in catalogue().items() if entry.section in here} <= used


def test_errors_are_made_of_the_catalogue_only() -> None:
    made = [
        f"{place}:{node.lineno}"
        for place, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and name_of(node) in KINDS
    ]

    assert not made, "use visloc.errors.refuse"


def test_refuse_is_given_the_values_of_its_sentence_and_a_listed_kind() -> None:
    for use in (use for use in USES if use.of_refuse):
        (key, *_) = keys_in(use)
        entry = catalogue()[key]
        given = {keyword.arg: keyword.value for keyword in use.call.keywords}
        named = {name for _, name, _, _ in string.Formatter().parse(entry.sentence) if name}

        has_own_message = len(use.call.args) > 1
        assert set(given) - RESERVED == (set() if has_own_message else named), use.place
        if isinstance(kind := given.get("kind"), ast.Name) and kind.id in KINDS:
            assert kind.id in {each.__name__ for each in entry.kinds[1:]}, use.place


def test_what_the_service_alone_raises_is_of_the_api() -> None:
    for use in USES:
        sections = {catalogue()[key].section for key in keys_in(use) if key in catalogue()}
        if use.place.startswith("service/") and sections - {"api"}:
            assert use.place.startswith(("service/keys.py", "service/security/key_file.py")), use


# refuse


def test_an_error_has_the_kind_and_the_sentence_of_its_code() -> None:
    error = refuse("camera.param_count", field="camera.params", got=3, model="PINHOLE")

    assert type(error) is InvalidInput
    assert error.message == "PINHOLE does not have this number of parameters"
    assert str(error).startswith("camera.params: PINHOLE does not")
    assert str(error).endswith("(got 3)")


def test_words_to_choose_from_are_listed() -> None:
    error = refuse("mode.unknown", expected=["photos", "rigs"])

    assert error.expected == "one of photos, rigs"


def test_a_place_may_know_more_than_the_catalogue() -> None:
    error = refuse("set.tile", "{curly} braces stay", kind=errors.NotFound)

    assert type(error) is errors.NotFound
    assert error.message == "{curly} braces stay"


def test_a_computed_code_is_of_its_family() -> None:
    assert refuse("options.top_k").message == catalogue()["options.*"].sentence
    with pytest.raises(KeyError):
        refuse("unheard.of")


@pytest.mark.parametrize("copied", [copy.copy, lambda e: pickle.loads(pickle.dumps(e))])
def test_an_error_survives_the_way_between_processes(copied: object) -> None:
    error = refuse("rig.id", field="rig", expected="less", got="more")

    again = copied(error)  # type: ignore[operator]

    assert type(again) is type(error)
    assert vars(again) == vars(error)


def test_the_same_error_about_another_field() -> None:
    error = refuse("rig.id", field="rig", got="more").about("images[0].rig", errors.DatasetError)

    assert type(error) is errors.DatasetError
    assert (error.code, error.field, error.got) == ("rig.id", "images[0].rig", "more")

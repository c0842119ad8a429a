"""Nothing lets faiss or pickle parse an index: maps come from strangers (decision 0034)."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = (
    *("visloc", "mapping", "service", "clients", "samples", "visloc_api"),
    *("visloc_extensions", "benchmarks"),
)
# Names of faiss's functions and classes that parse what they are given.
FORBIDDEN_STARTS = ("read_index", "deserialize_", "read_VectorTransform", "read_ProductQuantizer")
FORBIDDEN = frozenset(
    ("read_InvertedLists", "clone_index", "VectorIOReader", "FileIOReader", "BufferedIOReader")
)
# The only file that may load it.
HOME = ROOT / "visloc" / "retrieval" / "inverted.py"


def words(tree: ast.AST) -> Iterator[str]:
    """Every name, attribute, imported name, and short text in a file: getattr needs a text."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=word) | ast.Attribute(attr=word) | ast.alias(name=word):
                yield word
            case ast.Constant(value=str(word)):
                yield word


def forbidden(source: str) -> list[str]:
    tree = ast.parse(source)
    found = [w for w in words(tree) if w.startswith(FORBIDDEN_STARTS) or w in FORBIDDEN]
    if any(word == "faiss" for word in words(tree)):
        found += [w for w in words(tree) if w in ("pickle", "cPickle", "dill", "cloudpickle")]
    return found


@pytest.fixture(scope="module")
def suspects() -> dict[Path, str]:
    """The files that hold one of the names at all, and their text; few need to be parsed."""
    texts = {p: p.read_text() for package in PACKAGES for p in (ROOT / package).rglob("*.py")}
    marks = ("faiss", *FORBIDDEN_STARTS, *FORBIDDEN)
    return {path: text for path, text in texts.items() if any(mark in text for mark in marks)}


def test_no_file_lets_faiss_or_pickle_parse_an_index(suspects: dict[Path, str]) -> None:
    assert HOME in suspects
    assert {str(p): found for p, text in suspects.items() if (found := forbidden(text))} == {}


def test_one_file_loads_faiss(suspects: dict[Path, str]) -> None:
    loading = [p for p, text in suspects.items() if "faiss" in set(words(ast.parse(text)))]
    assert loading == [HOME]


@pytest.mark.parametrize(
    "source",
    [
        "import faiss\nfaiss.read_index('x')",
        "from faiss import read_index_binary as r",
        "import faiss\ngetattr(faiss, 'deserialize_index')(b'')",
        "import faiss as f\nf.read_VectorTransform('x')",
        "import faiss\nimport pickle\npickle.loads(b'')",
        "import faiss\nfaiss.FileIOReader('x')",
    ],
)
def test_every_way_to_parse_one_is_found(source: str) -> None:
    assert forbidden(source)

"""Do the tests still find the same small faults? For changes that move code and tests about.

    python -m benchmarks.mutants draw FILE --count 100 --seed 0    # before
    python -m benchmarks.mutants check FILE                        # after

``draw`` picks places in the functions of the product at random, plants one small fault at a time
(``<`` for ``<=``, ``and`` for ``or``, another number), and keeps those that the tests of the same
folder find, with the test that found them. It goes on where FILE ends. ``check`` plants each again
and runs that test alone; it exits with 1 where a fault survives, or where its place or its test
isn't there any more. A fault is known by the names of its class and function and by its line, a
test by its file's name and its own: files may move, those lines may not change.

Faults are planted in the files themselves, and taken out again whatever happens. Let nothing else
use the checkout meanwhile.
"""

from __future__ import annotations

import ast
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("visloc", "mapping", "service", "clients", "visloc_api", "visloc_extensions")
GENERATED = "visloc_api/v1/"
TESTS = ("tests", "visloc_extensions")
PAIRS = [("<", "<="), (">", ">="), ("==", "!="), ("is", "is not"), ("in", "not in"), ("and", "or")]
PAIRS += [("+", "-"), ("*", "/"), ("+=", "-="), ("*=", "/=")]
SWAPPED = {**dict(PAIRS), **{b: a for a, b in PAIRS}}
OPERATOR = re.compile(r"[\s()]*(is\s+not\b|not\s+in\b|[a-z]+|[^\w\s()]+)")
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+?\.py(?:::[\w:]+)?)", re.MULTILINE)
PYTEST = [
    *("-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow"),
    *("--tb=no", "--color=no", "--hypothesis-seed=0"),
]
app = typer.Typer(add_completion=False, no_args_is_help=True)


@dataclass(frozen=True)
class Fault:
    """A fault: ``before``, at ``column`` of ``lines`` less their indentation, becomes ``after``."""

    function: str
    lines: str
    column: int
    before: str
    after: str
    file: str  # where it was then, for the reader only
    test_file: str = ""
    test: str = ""  # empty where the test's file couldn't even be loaded

    def __str__(self) -> str:
        before, after = (" ".join(text.split())[:40] for text in (self.before, self.after))
        return f"{self.file}, {self.function}: {before} -> {after or 'nothing'}"


class Source:
    """A file of the product: the function of each line, and all faults that could be planted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text = path.read_text(encoding="utf-8")
        self._lines = self.text.split("\n")
        self._starts = list(accumulate((len(line) + 1 for line in self._lines), initial=0))
        self.functions = [""] * len(self._lines)
        self.faults: list[Fault] = []
        self._look(ast.parse(self.text), (), inside=False)

    def _look(self, node: ast.AST, names: tuple[str, ...], inside: bool) -> None:
        below = list(ast.iter_child_nodes(node))
        sides: list[tuple[ast.expr, ast.expr]] = []  # of operators
        start, end = 0, 0
        if isinstance(node, ast.UnaryOp | ast.Constant | ast.Return):
            start, end = self._span(node)
        made: list[tuple[int, int, str]] = []
        match node:
            case ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef():
                names = (*names, node.name)
                inside |= not isinstance(node, ast.ClassDef)
                for line in range(node.body[0].lineno - 1, node.body[-1].end_lineno or 0):
                    self.functions[line] = ".".join(names)
                below = [*node.body]  # neither decorators, defaults nor annotations
            case ast.If() if re.search("TYPE_CHECKING|__name__", ast.unparse(node.test)):
                return
            case ast.keyword(arg="strict") | ast.JoinedStr():
                return  # strict=True is never wrong; Python 3.11 doesn't say where the latter is
            case ast.AnnAssign():
                below = [node.value] if node.value else []
            case ast.Compare():
                sides = list(zip([node.left, *node.comparators], node.comparators, strict=False))
            case ast.BoolOp():
                sides = list(zip(node.values, node.values[1:], strict=False))
            case ast.BinOp(ast.Constant(str()), _, _) | ast.BinOp(_, _, ast.Constant(str())):
                pass  # texts and paths: whatever test comes by finds that
            case ast.BinOp():
                sides = [(node.left, node.right)]
            case ast.AugAssign():
                sides = [(node.target, node.value)]
            case ast.UnaryOp(op=ast.Not()):
                made = [(start, start + len("not "), "")]
            case ast.Constant(bool(value)):
                made = [(start, end, repr(not value))]
            case ast.Constant(int(number) | float(number)):
                made = [(start, end, repr(number + 1))]
            case ast.Return(ast.expr()):
                made = [(start + len("return "), end, "None")]
        for left, right in sides:
            sign = OPERATOR.match(self.text, self._span(left)[1], self._span(right)[0])
            if sign and sign[1] in SWAPPED:
                made.append((*sign.span(1), SWAPPED[sign[1]]))
        if inside:
            for one in made:
                self._add(".".join(names), *one)
        for each in below:
            self._look(each, names, inside)

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        last = node.end_lineno or 0
        return self._at(node.lineno, node.col_offset), self._at(last, node.end_col_offset or 0)

    def _at(self, line: int, offset: int) -> int:
        # ast counts bytes
        return self._starts[line - 1] + len(self._lines[line - 1].encode()[:offset].decode())

    def _add(self, function: str, start: int, end: int, after: str) -> None:
        first, last = self.text.rfind("\n", 0, start) + 1, self.text.find("\n", end)
        lines, before = self.text[first:last].lstrip(), self.text[start:end]
        column = start - (last - len(lines))
        file = self.path.relative_to(ROOT).as_posix()
        if before != after:
            self.faults.append(Fault(function, lines, column, before, after, file))

    def places_of(self, fault: Fault) -> list[tuple[Source, int]]:
        """Return the offsets where the file has such a line in such a function."""
        line = re.compile(rf"^ *({re.escape(fault.lines)})$", re.MULTILINE)
        found = line.finditer(self.text) if fault.lines in self.text else ()
        return [
            (self, each.start(1) + fault.column)
            for each in found
            if self.functions[self.text.count("\n", 0, each.start())] == fault.function
        ]


def read_product() -> list[Source]:
    """Read all Python files of the product but tests and what is generated."""
    files = [path for folder in PRODUCT for path in sorted((ROOT / folder).rglob("*.py"))]
    other = re.compile(rf"^{GENERATED}|(^|/)(test_|conftest)")
    return [Source(path) for path in files if not other.search(str(path.relative_to(ROOT)))]


@contextmanager
def planted(fault: Fault, source: Source, start: int) -> Iterator[None]:
    """Plant a fault in the file, and take it out again."""
    kept, times = source.path.read_bytes(), source.path.stat()
    text = source.text[:start] + fault.after + source.text[start + len(fault.before) :]
    try:
        source.path.write_text(text, encoding="utf-8")
        yield
    finally:
        source.path.write_bytes(kept)
        os.utime(source.path, ns=(times.st_atime_ns, times.st_mtime_ns))


def run_tests(tests: Sequence[str], seconds: float, *options: str) -> list[str] | None:
    """Return the tests that fail, "" for pytest itself; None where they take longer than that."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {
            "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}",
            "PYTHONDONTWRITEBYTECODE": "1",  # no compiled file may outlive its fault
            "HYPOTHESIS_STORAGE_DIRECTORY": f"{folder}/hypothesis",
        }
        process = subprocess.Popen(
            [sys.executable, *PYTEST, f"--basetemp={folder}/tests", *options, *tests],
            cwd=ROOT,
            env=os.environ | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            return None
        finally:
            with suppress(ProcessLookupError):  # what a test started and left ends too
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    failed = FAILED.findall(output)
    return failed or ([] if process.returncode in (0, 5) else [""])  # 5: no tests


@cache
def imports() -> dict[Path, set[str]]:
    """Return what each file of the product and of the tests imports, or may."""
    found: dict[Path, set[str]] = {}
    for path in (path for folder in (*PRODUCT, *TESTS) for path in (ROOT / folder).rglob("*.py")):
        names = found.setdefault(path.relative_to(ROOT), set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
            elif isinstance(node, ast.Import):
                names |= {each.name for each in node.names}
    return found


def nearest_tests(fault: Fault) -> list[list[str]]:
    """Return files of tests: of the folder that mirrors the fault's, nearest first, then others."""
    steps = {Path(fault.file): 0}  # imports from there to the fault
    new = set(steps)
    while new:
        reached = {".".join(p.with_suffix("").parts).removesuffix(".__init__") for p in new}
        new = {path for path, names in imports().items() if names & reached} - set(steps)
        steps.update(dict.fromkeys(new, max(steps.values()) + 1))
    package = ROOT / "tests" / Path(fault.file).parts[0]
    texts = {each: each.read_text(encoding="utf-8") for each in package.rglob("test_*.py")}
    near = {each: float(steps.get(each.relative_to(ROOT), 9)) for each in texts}
    near.update({each: 0.0 for each in texts if each.name == f"test_{Path(fault.file).name}"})
    for name in fault.function.split("."):
        naming = [each for each, text in texts.items() if re.search(rf"\b{name}\b", text)]
        for each in naming:
            near[each] -= 2.0 / len(naming)  # a name that all mention says nothing
    folder = next(each for each in (ROOT / "tests" / fault.file).parents if each.is_dir())
    order = sorted(near, key=lambda each: (folder not in each.parents, near[each], each))
    files = [each.relative_to(ROOT).as_posix() for each in order]
    return [files[:3], files[3:9], files[9:18]]  # to load a file takes time too


def first_failing(
    fault: Fault, place: tuple[Source, int], seconds: float, known: dict[str, bool]
) -> str:
    """Return the first test that fails because of the fault; "" where none does in that time.

    ``known`` says which tests pass without it.
    """
    until = time.monotonic() + seconds
    for files in nearest_tests(fault):
        broken = [f"--deselect={test}" for test, passes in known.items() if not passes]
        with planted(fault, *place):
            failed = run_tests(files, until - time.monotonic(), "-x", *broken) if files else []
        if failed is None or failed == [""]:
            return ""
        for test in failed[:1]:
            if test not in known:
                known[test] = run_tests([test], seconds) == []
            return test if known[test] else ""
    return ""


def tests_of(fault: Fault) -> list[str]:
    """Return the tests of this name in files of this name: one, if all is well."""
    line = re.compile(rf"^ *(?:async )?def {fault.test.rpartition(':')[2]}\(", re.MULTILINE)
    files = [file for folder in TESTS for file in sorted((ROOT / folder).rglob(fault.test_file))]
    return [
        f"{file.relative_to(ROOT).as_posix()}::{fault.test}".removesuffix("::")
        for file in files
        if not fault.test or line.search(file.read_text(encoding="utf-8"))
    ]


@app.command()
def draw(
    file: Path,
    count: Annotated[int, typer.Option(help="Faults to find.")] = 100,
    seed: int = 0,
    limit: Annotated[float, typer.Option(help="Seconds of tests for each fault.")] = 60.0,
) -> None:
    """Plant faults at random until the tests have found so many."""
    kept = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    found, missed = ([Fault(**each) for each in kept.get(key, ())] for key in ("found", "missed"))
    sources = read_product()
    faults = [fault for source in sources for fault in source.faults]
    random.Random(seed).shuffle(faults)
    drawn = {replace(fault, test_file="", test="") for fault in (*found, *missed)}
    known: dict[str, bool] = {}
    for fault in (fault for fault in faults if fault not in drawn):
        if len(found) >= count:
            break
        places = [place for source in sources for place in source.places_of(fault)]
        if len(places) != 1:  # nobody could say later which of them it was
            continue
        began = time.monotonic()
        path, _, name = first_failing(fault, places[0], limit, known).partition("::")
        (found if path else missed).append(replace(fault, test_file=Path(path).name, test=name))
        text = {"found": [asdict(each) for each in found], "missed": [asdict(m) for m in missed]}
        file.write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")
        typer.echo(f"{fault}: {path or 'not found'} {name}, {time.monotonic() - began:.0f} s")
    typer.echo(f"{len(found) + len(missed)} drawn, {len(found)} found, {len(missed)} not in time")
    broken = [test for test, passes in known.items() if not passes]
    typer.echo(f"tests that fail without any fault: {', '.join(broken) or 'none'}")


@app.command()
def check(
    file: Path,
    some: Annotated[int, typer.Option(help="So many at random; 0: all.")] = 0,
    limit: Annotated[float, typer.Option(help="Seconds of tests for each fault.")] = 180.0,
) -> None:
    """Plant the faults again, and say which are no longer found."""
    faults = [Fault(**each) for each in json.loads(file.read_text(encoding="utf-8"))["found"]]
    faults = random.sample(faults, some) if some else faults
    sources = read_product()
    tests = sorted({test for fault in faults for test in tests_of(fault)})
    # A test that fails anyway would find everything.
    failing = run_tests(tests, limit * len(faults)) if tests else []
    if failing is None or failing == [""]:
        raise typer.BadParameter("the tests cannot be run without any fault")
    wrong = 0
    for fault in faults:
        places = [place for source in sources for place in source.places_of(fault)]
        tests = tests_of(fault)
        test = f"{fault.test_file} {fault.test}"
        if len(places) != 1:
            problem = f"not found: {len(places)} places have this line"
        elif not tests:
            problem = f"not found: no test {test}"
        elif any(f"{bad}::".startswith(f"{test}::") for bad in failing for test in tests):
            problem = f"{test} fails without it"
        else:
            with planted(fault, *places[0]):
                failed = run_tests(tests, limit, "-x")
            problem = "" if failed else f"survives {test}" + " for long" * (failed is None)
        wrong += bool(problem)
        typer.echo(f"{fault}: {problem or 'found'}")
    typer.echo(f"{len(faults) - wrong} of {len(faults)} found")
    raise typer.Exit(1 if wrong else 0)


if __name__ == "__main__":
    # Without this, no fault would be taken out again when the process is told to end.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    app()

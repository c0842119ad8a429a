"""Every command that the docs print: run for real, parsed, or listed with what it needs.

    python -m tests.docs_check [PAGE ...]

Runs in a scratch folder: the demo first, then page after page in the order in which the commands
are printed, each page with its own copy of the maps and its own server on the loopback interface.
``RULES`` says which commands are only parsed, and which need what is not here; every other command
runs. What docs/extensions.md says that an extension adds is skipped where that one is not here. A
block of JavaScript is saved in the file that its first line names, as its reader does. A
line of a shell block that starts with no known program is an error, so blocks that hold no commands
name their language (```text).
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np
import typer
from typer.core import TyperGroup

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted(ROOT.glob("visloc_extensions/*/README.md")),
    ROOT / "examples" / "plugin" / "README.md",
)
DATA = ROOT.parent / "shared" / "data"
REAL = ("castle", "redkitchen", "kitti_curve", "virtual_gallery", "lund_door")
# The maps here are smaller than a reader's.
SMALLER = {
    "--max-bytes 200MB": "--max-bytes 1500KB",
    "--max-landmarks 100000": "--max-landmarks 3000",
}
ASKS_NO_SERVER = ("evaluate", "submit")  # of the commands of `localize`
COMMAND_LIMIT_S = 400
READY_WITHIN_S = 60


# Reading


@dataclass(frozen=True)
class Command:
    """A command as a page prints it.

    Attributes:
        page: relative to the repository.
        line: where its block, or its code span, begins.
        text: on one line, without comments; of Python all lines of the block.
        is_python: whether it is a block of Python.
        is_inline: whether it stands in a sentence, as an example of usage; never run.
        saved_as: the file that a reader writes it to, of JavaScript; empty for others.
    """

    page: str
    line: int
    text: str
    is_python: bool = False
    is_inline: bool = False
    saved_as: str = ""

    @property
    def words(self) -> list[str]:
        """Without variables before it, and without what a pipe or a file takes."""
        words = shlex.split(re.split(r" (?:\||&&|>) ", self.text)[0])
        while re.match(r"[A-Z_]+=", words[0]):
            words.pop(0)
        words[0] = words[0].removeprefix(".venv/bin/")
        return words


def commands_of(page: Path) -> list[Command]:
    """Read the commands of a page in their order: of its blocks, then those in sentences."""
    text, name = page.read_text(encoding="utf-8"), page.relative_to(ROOT).as_posix()
    found = []
    for block in re.finditer(r"^```(\S*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        language, body = block.groups()
        line = text.count("\n", 0, block.start()) + 2
        if language == "python":
            found.append(Command(name, line, body, is_python=True))
        elif language == "js":
            found.append(Command(name, line, body, saved_as=_first_comment(body)))
        elif language in ("", "sh", "bash"):
            for printed in body.replace("\\\n", " ").splitlines():
                command = re.sub(r"(^|\s+)#.*", "", printed).strip()
                if command:
                    found.append(Command(name, line, re.sub(r"\s{2,}", " ", command)))
    prose = re.sub(r"^```.*?^```$", lambda b: "\n" * b[0].count("\n"), text, flags=re.M | re.S)
    for span in re.finditer(r"`((?:\.venv/bin/)?python [^`]+)`", prose):
        line = prose.count("\n", 0, span.start()) + 1
        found.append(Command(name, line, span[1].replace("\n", " "), is_inline=True))
    return found


def _first_comment(body: str) -> str:
    """Return the relative path of a JavaScript file that its first line names."""
    named = re.match(r"// ([\w/-]+\.mjs)\n", body)
    assert named is not None, f"a block of JavaScript names no file: {body[:60]}"
    return named[1]


# Judging


class Tier(StrEnum):
    """What is done with a command."""

    RUN = "run"
    PARSED = "parsed"
    ELSEWHERE = "elsewhere"


@dataclass(frozen=True)
class Rule:
    """What is done with the commands of some pages.

    Attributes:
        pages: how the pages' paths match.
        pattern: how the commands begin, without ``.venv/bin/``.
        reason: why they do not run here.
    """

    tier: Tier
    pages: str
    pattern: str
    reason: str = ""


_HOURS = "minutes to hours over ../shared/data"
_PLACES = "needs maps of several places; tests/mapping/maps/test_sets.py"
# The first that matches counts.
RULES = (
    Rule(Tier.ELSEWHERE, r"", r"(TAG=\d+ )?docker ", "a Docker daemon; tests/test_deploy.py"),
    Rule(Tier.ELSEWHERE, r"", r"kubectl ", "a cluster; tests/test_deploy_kubernetes.py"),
    Rule(Tier.ELSEWHERE, r"", r"export VISLOC_API_KEY", "a key of the reader's own"),
    Rule(Tier.ELSEWHERE, r"", r"python -m http\.server", "would not end; test_web_overlay.py"),
    Rule(Tier.ELSEWHERE, r"", r"pip (install|wheel)", "pip; tests/examples/test_plugin.py"),
    Rule(Tier.ELSEWHERE, r"", r"curl .*//maps\.example\.org", "a host of that name"),
    Rule(Tier.PARSED, r"", r"([A-Z]+=\S+ |[A-Z]+=\".*\" )?make ", "a target of its own"),
    Rule(Tier.PARSED, r"examples/plugin", r"", "needs it installed; tests/examples/test_plugin.py"),
    Rule(Tier.PARSED, r"visloc_extensions/scans", r"", "needs a scan of a phone; its tests"),
    Rule(Tier.PARSED, r"extensions/graphs", r"mapping export-graph", "needs weights; its tests"),
    Rule(Tier.PARSED, r"extensions/sets", r"mapping (set|split)", _PLACES),
    Rule(Tier.PARSED, r"capture/README", r"mapping capture", "the tutorial runs it"),
    Rule(Tier.PARSED, r"your-app", r"visloc-service .*cors", "test_web_overlay.py"),
    Rule(
        Tier.PARSED,
        r"mapping\.md",
        r".* --method model",
        "tests/mapping/methods/test_known_model.py",
    ),
    Rule(
        Tier.PARSED,
        r"mapping\.md",
        r"mapping anchor .* --dataset",
        "needs better GNSS; test_anchor.py",
    ),
    Rule(Tier.PARSED, r"mapping\.md", r".*mapping upgrade", "needs an old map; test_upgrading.py"),
    Rule(Tier.PARSED, r"mapping\.md", r"mapping anchor .* --corr", "needs points; test_anchor.py"),
    Rule(Tier.PARSED, r"mapping\.md", r"mapping edit", "needs those photos; test_sizing.py"),
    Rule(Tier.PARSED, r"mapping\.md", r".* recorded .* rgbd", "needs a recording with depth"),
    Rule(Tier.PARSED, r"operations", r"visloc-service --host 0\.0", "would listen to the network"),
    Rule(Tier.PARSED, r"visloc_extensions/ray", r"mapping .* --executor ray", "needs a cluster"),
    *(
        Rule(Tier.RUN, r"results\.md", pattern)
        for pattern in (
            r"mapping build castle/mapping --map castle-xfeat",
            r".*--map gallery",
            r"visloc-service --maps-dir \S+$",
            r"cp |sed ",
            r"localize benchmark unknown",
            r"mapping (import|export)",
            r"localize benchmark \.demo",
            r"mapping sample",
            r"mapping build a/mapping",
            r"localize benchmark b/query",
        )
    ),
    Rule(Tier.PARSED, r"results|rigs-and|scale\.md|performance", r"", _HOURS),
    Rule(Tier.PARSED, r"operations|decisions", r"(\w+=\S+ )*python -m benchmarks", _HOURS),
    Rule(Tier.PARSED, r"living_maps|extensions/sets|mapping\.md", r"python ", _HOURS),
    Rule(Tier.PARSED, r"visloc_extensions/training", r"", "hours of training"),
)
PROGRAMS = (
    *("mapping", "localize", "visloc-service", "python", "make"),
    *("curl", "cp", "mkdir", "sed", "openssl", "printf", "node", "npm"),
)


def judged(command: Command) -> Rule:
    """Return what is done with a command; it runs unless a rule says otherwise.

    Raises:
        ValueError: it begins with no known program.
    """
    if command.is_python or command.saved_as:
        return Rule(Tier.RUN, "", "")
    if command.is_inline:
        return Rule(Tier.PARSED, "", "", "usage in a sentence")
    text = command.text.replace(".venv/bin/", "")
    matching = (r for r in RULES if re.search(r.pages, command.page) and re.match(r.pattern, text))
    rule = next(matching, Rule(Tier.RUN, "", ""))
    known = {Tier.RUN: PROGRAMS, Tier.PARSED: (*_PARSERS, "make")}
    if rule.tier is not Tier.ELSEWHERE and command.words[0] not in known[rule.tier]:
        raise ValueError(f"{command.page}:{command.line}: nothing is known of {command.text!r}")
    return rule


# Parsing


class NotHere(Exception):
    """The command is of an extension that is not here, which this names."""


def absent() -> dict[str, str]:
    """How the commands begin that extensions add which are not here, and the name of each."""
    page = (ROOT / "docs" / "extensions.md").read_text(encoding="utf-8")
    return {
        command: name
        for name, adds in re.findall(r"^\| `(\w+)` \| (.*?) \|", page, re.M)
        for command in re.findall(r"`([^`]+)`", adds)
        if not (ROOT / "visloc_extensions" / name / "__init__.py").exists()
    }


# typer brings a click of its own, of whose errors it exports this one's children only.
_UsageError = typer.BadParameter.__mro__[1]


def parse(command: Command) -> None:
    """Parse a command as its program would, without running it; other programs' pass.

    Raises:
        NotHere: an extension adds it.
        ValueError: the program does not take it.
    """
    if command.is_python:
        compile(command.text, f"{command.page}:{command.line}", "exec")
        return
    if command.saved_as:
        return  # node tells when it runs
    for beginning, name in absent().items():
        if f"{shlex.join(command.words)} ".startswith(f"{beginning} "):
            raise NotHere(name)
    program, *arguments = command.words
    if program == "make":
        _parse_make(command)
    parser = _PARSERS.get(program)
    if parser is None:
        return
    try:
        if command.is_inline and arguments[0] == "-m" and len(arguments) == 2:
            importlib.import_module(arguments[1])  # only named
        else:
            parser(arguments)
    except ModuleNotFoundError as error:  # of a benchmark
        package, _, name = (error.name or "").partition(".")
        if package != "visloc_extensions":
            raise
        raise NotHere(name.partition(".")[0]) from error
    except _UsageError as error:
        raise ValueError(f"{command.text}: {error}") from error
    except SystemExit as error:
        if error.code:
            raise ValueError(f"{command.text}: not what it takes") from error


def _parse_typer(app: typer.Typer, arguments: Sequence[str]) -> None:
    command, words = typer.main.get_command(app), list(arguments)
    while isinstance(command, TyperGroup):
        context = command.make_context(command.name, list(words))
        _, chosen, words = command.resolve_command(context, words)
        assert chosen is not None  # or it has raised
        command = chosen
    command.make_context(command.name, words)


def _parse_mapping(arguments: Sequence[str]) -> None:
    from mapping.cli.main import app

    _parse_typer(app, arguments)


def _parse_localize(arguments: Sequence[str]) -> None:
    from clients.cli.main import app

    _parse_typer(app, arguments)


def _parse_service(arguments: Sequence[str]) -> None:
    from service.settings import read_settings

    read_settings(arguments, {})


def _parse_python(arguments: Sequence[str]) -> None:
    if arguments[0] == "-X":
        arguments = arguments[2:]
    if arguments[0] == "-c":
        compile(arguments[1], "-c", "exec")
        return
    if arguments[0] == "-m":
        name, given = arguments[1], arguments[2:]
    else:
        if not (ROOT / arguments[0]).is_file():
            raise ValueError(f"there is no {arguments[0]}")
        name, given = arguments[0].removesuffix(".py").replace("/", "."), arguments[1:]
    if name == "service":
        _parse_service(given)
        return
    try:
        module = importlib.import_module(f"{name}.__main__")
    except ModuleNotFoundError:
        module = importlib.import_module(name)
    if hasattr(module, "_parser"):
        module._parser().parse_args(given)
    elif hasattr(module, "app"):
        _parse_typer(module.app, given)
    elif "typer" in vars(module):
        app = typer.Typer(add_completion=False)
        app.command()(module.main)
        _parse_typer(app, given)


def _parse_make(command: Command) -> None:
    """Parse what make would run."""
    text = command.text.replace("make ", "make --dry-run ", 1)
    try:
        printed = call(ROOT, ["bash", "-c", text])
    except CommandFailed as error:
        raise ValueError(f"{command.text}: {error}") from error
    for line in printed.replace("\\\n", " ").splitlines():
        if line.startswith(".venv/bin/python "):
            parse(replace(command, text=line))


_PARSERS: dict[str, Callable[[Sequence[str]], None]] = {
    "mapping": _parse_mapping,
    "localize": _parse_localize,
    "visloc-service": _parse_service,
    "python": _parse_python,
}


# Running


class CommandFailed(Exception):
    """With what the command printed."""


@dataclass
class Desk:
    """A reader's folder, the service that was started there last, and all that was printed."""

    folder: Path
    http: str = ""
    grpc: str = ""
    service: subprocess.Popen[bytes] | None = None
    printed: str = ""

    def run(self, command: Command) -> None:
        """Run a command.

        Raises:
            CommandFailed: it failed, took too long, or localized nothing.
        """
        if command.saved_as:
            file = self.folder / command.saved_as
            file.parent.mkdir(exist_ok=True)
            file.write_text(command.text.replace("127.0.0.1:8000", self.http))
            return
        if not command.is_python and command.words[0] == "visloc-service":
            self.serve(command.words[1:])
            return
        if not self.http and (asks_server(command) or "127.0.0.1:" in command.text):
            self.serve(["--maps-dir", "maps"])
        text = command.text.replace("127.0.0.1:8000", self.http)
        text = text.replace("127.0.0.1:50051", self.grpc)
        for printed, here in SMALLER.items():
            text = text.replace(printed, here)
        if command.is_python:
            self.printed += call(self.folder, [sys.executable, "-c", text])
            return
        printed = call(self.folder, ["bash", "-o", "pipefail", "-c", text + self.added(command)])
        self.printed += printed
        if command.words[0] == "curl" and json.loads(printed)["status"] != "localized":
            raise CommandFailed(printed)

    def added(self, command: Command) -> str:
        """Return the flags of a reader whose ports, and maps of that name, are taken."""
        words = command.words
        if asks_server(command) and "--server" not in words:
            return f" --server http://{self.http}"
        if words[0] == "curl":
            return " --silent --show-error"
        publishes = words[:2] in (["mapping", "build"], ["mapping", "import"]) and "--map" in words
        if publishes and (self.folder / "maps" / words[words.index("--map") + 1]).exists():
            return " --force"
        return ""

    def serve(self, flags: Sequence[str]) -> None:
        """Start the service, on free ports, in place of the one before.

        Raises:
            CommandFailed: it does not become ready.
        """
        self.close()
        taken = " ".join(flags).replace("8000", "0").replace("50051", "0").split()
        for flag in ("--http-port", "--grpc-port"):
            if flag not in taken:
                taken += [flag, "0"]
        log = self.folder / "service.log"
        with log.open("wb") as file:
            self.service = subprocess.Popen(
                [sys.executable, "-m", "service", "--workers=1", *taken],
                cwd=self.folder,
                env=environment(),
                stderr=file,
            )
        until = time.monotonic() + READY_WITHIN_S
        while not (found := re.search(r"ready: https?://(\S+) grpcs?://(\S+),", log.read_text())):
            if time.monotonic() > until or self.service.poll() is not None:
                raise CommandFailed(log.read_text())
            time.sleep(0.2)
        self.http, self.grpc = found.groups()

    def close(self) -> None:
        """End the service."""
        if self.service is not None:
            self.service.terminate()
            self.service.wait()
        self.service, self.http, self.grpc = None, "", ""


def asks_server(command: Command) -> bool:
    """Return whether it is a `localize` command that asks a service."""
    if command.is_python or command.saved_as:
        return False
    program, *arguments = command.words
    return program == "localize" and arguments[0] not in ASKS_NO_SERVER


def environment() -> dict[str, str]:
    """Return the environment of a reader who has activated ``.venv`` in the repository."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PATH": path, "PYTHONPATH": paths, "COLUMNS": "120"}


def call(folder: Path, words: Sequence[str]) -> str:
    """Run a program in a folder and return what it printed.

    Raises:
        CommandFailed: its status is not 0, or it takes too long.
    """
    try:
        done = subprocess.run(
            words,
            cwd=folder,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=COMMAND_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise CommandFailed(f"not done within {COMMAND_LIMIT_S} s") from error
    if done.returncode:
        raise CommandFailed(f"exit status {done.returncode}\n{done.stdout}")
    return done.stdout


def prepare(base: Path) -> None:
    """Make what the pages start from: the demo, and small maps for the names in capitals."""
    (base / ".venv").symlink_to(Path(sys.executable).parents[1])
    call(base, [sys.executable, str(ROOT / "examples" / "demo.py")])
    call(base, ["mapping", "sample", "small", "--images", "24", "--size", "320x240"])
    for name in ("monday", "tuesday"):
        copy_renamed(base / "small" / "mapping", base / "small" / name)
    call(base, ["mapping", "build", "small/mapping", "--map", "kitchen"])
    call(base, ["mapping", "build", "small/query", "--map", "hall", "--method", "sfm"])
    call(base, [sys.executable, str(ROOT / "examples" / "film.py")])
    for script in sorted(ROOT.glob("visloc_extensions/*/tests/prepare_docs.py")):
        call(base, [sys.executable, str(script)])


def copy_renamed(source: Path, target: Path) -> None:
    """Copy a dataset of the sample as another capture: the same photos under other names."""
    shutil.copytree(source, target)
    for kind in ("records_data", "depth_data"):
        for folder in (target / "sensors").glob(f"{kind}/{source.name}"):
            folder.rename(folder.with_name(target.name))
    for table in (target / "sensors").glob("*.txt"):
        table.write_text(table.read_text().replace(f"{source.name}/", f"{target.name}/"))


def desk_of(base: Path, page: str) -> Desk:
    """Lay out a folder for a page: copies of what commands change, links to what they read."""
    folder = base / page.replace("/", "-")
    for name in (".demo", "maps"):
        shutil.copytree(base / name, folder / name)
    links = {
        ".venv": base / ".venv",
        "DATASET": base / "small" / "mapping",
        "MONDAY": base / "small" / "monday",
        "TUESDAY": base / "small" / "tuesday",
        "QUERIES": base / "small" / "query",
        "PHOTOS": base / "small" / "query" / "sensors" / "records_data" / "query" / "left",
        "examples": ROOT / "examples",
        "benchmarks": ROOT / "benchmarks",
        "web": ROOT / "web",
    }
    if DATA.is_dir():
        links |= {path.name: path for path in DATA.iterdir() if path.is_dir()}
        links["lund_door"] = DATA / "import_samples" / "lund_door"
    for name, target in links.items():
        (folder / name).symlink_to(target)
    for file in (path for path in base.iterdir() if path.is_file()):
        shutil.copy(file, folder)
    recording = folder / "RECORDING"
    recording.mkdir()
    shutil.copy(folder / ".demo" / "photo.jpg", recording)
    frame = {"file_path": "photo.jpg", "transform_matrix": np.eye(4).tolist()}
    scene = {"camera_angle_x": 1.0, "frames": [frame]}
    (recording / "transforms.json").write_text(json.dumps(scene))
    return Desk(folder)


def check(pages: Sequence[Path], base: Path) -> int:
    """Check pages, tell of each command, and return how many failed."""
    prepare(base)
    counts: Counter[str] = Counter()
    for page in pages:
        name = page.relative_to(ROOT).as_posix()
        desk = desk_of(base, name)
        try:
            for command in commands_of(page):
                start = time.monotonic()
                did, problem = checked(command, desk)
                counts["failed" if problem else did.partition(":")[0]] += 1
                shown = command.text.partition("\n")[0][:100]
                say(f"{time.monotonic() - start:6.1f} s  {name}:{command.line}  {shown}  [{did}]")
                if problem:
                    say(f"FAILED: {problem[-3000:]}")
        finally:
            desk.close()
    say(", ".join(f"{count} {what}" for what, count in counts.items()))
    return counts["failed"]


def checked(command: Command, desk: Desk) -> tuple[str, str]:
    """Do with a command what its rule says; return what was done, and what went wrong."""
    rule = judged(command)
    absent = next((name for name in REAL if name in command.text and not DATA.is_dir()), None)
    try:
        parse(command)
        if rule.tier is Tier.RUN and absent:
            return f"parsed: {absent} is not in ../shared/data", ""
        if rule.tier is Tier.RUN:
            desk.run(command)
    except NotHere as error:
        return f"skipped: the extension {error} is not here", ""
    except (CommandFailed, ValueError) as error:
        return rule.tier, str(error)
    return f"{rule.tier}: {rule.reason}" if rule.reason else rule.tier, ""


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> int:
    """Check the pages that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m tests.docs_check", description=__doc__)
    parser.add_argument("pages", nargs="*", type=Path, help="default: all")
    pages = [page.resolve() for page in parser.parse_args().pages] or PAGES
    with tempfile.TemporaryDirectory(prefix="visloc-docs-") as base:
        return 1 if check(pages, Path(base)) else 0


if __name__ == "__main__":
    sys.exit(main())

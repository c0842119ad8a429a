"""The core without extensions: its checks and its tests pass when their folders are deleted.

    python -m tools.apart                # without each in turn: checks and the core's tests
    python -m tools.apart capture ros    # without these, each in turn
    python -m tools.apart --all          # without all of them at once
    python -m tools.apart --all --only tests

Works in a copy of the working tree, ``.apart/tree``: deletes the folder of an extension and of
those that need it, and their lines in pyproject.toml.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "visloc_extensions"
APART = ROOT / ".apart"
TREE = APART / "tree"
# Built and installed things, which git does not know: links to those of the checkout.
LINKED = (".venv", "web/node_modules", "service/page/built")
COPIED = "web/client/dist"  # npm packs no links
# Its commands and links are those of the core and the extensions.
OF_THE_WHOLE = "tests/test_docs.py"
CHECKS = "lint types contracts licences-check proto-check site size"
# As ``make test`` runs tests.
PYTEST = ("-m", "not slow", "--numprocesses", "2", "--dist", "loadfile", "--no-loadscope-reorder")
NATIVE = "visloc/matching/native/*.so"


def names() -> list[str]:
    """Return the names of all extensions."""
    return sorted(path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py"))


def needed_by(name: str) -> set[str]:
    """Return the extensions that import this one, and those that import them."""
    found = {name}
    for other in names():
        texts = (file.read_text("utf-8") for file in (ROOT / PACKAGE / other).rglob("*.py"))
        if other != name and any(f"{PACKAGE}.{name}" in text for text in texts):
            found |= needed_by(other)
    return found


def copy_without(gone: Iterable[str]) -> None:
    """Make the copy: what git would commit, without some extensions and their lines."""
    shutil.rmtree(APART, ignore_errors=True)
    listed = _git(ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    for name in filter(None, listed.split("\0")):
        source, target = ROOT / name, TREE / name
        if source.exists():  # not deleted since it was committed
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
    for name in LINKED:
        if (ROOT / name).exists():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            (TREE / name).symlink_to((ROOT / name).resolve())
    if (ROOT / COPIED).exists():
        shutil.copytree(ROOT / COPIED, TREE / COPIED)
    for file in ROOT.glob(NATIVE):
        shutil.copy2(file, TREE / file.relative_to(ROOT))
    if (shared := ROOT.parent / "shared").is_dir():
        (APART / "shared").symlink_to(shared.resolve())
    project = TREE / "pyproject.toml"
    text = project.read_text("utf-8")
    for name in gone:
        shutil.rmtree(TREE / PACKAGE / name)
        text = re.sub(rf"^.*\b{PACKAGE}[./]{name}\b.*\n", "", text, flags=re.MULTILINE)
    project.write_text(text, "utf-8")
    # proto-check asks git what the generator changed.
    for arguments in (("init", "--quiet"), ("add", "--all"), ("commit", "--quiet", "-m", "copy")):
        _git(TREE, "-c", "user.name=apart", "-c", "user.email=apart@localhost", *arguments)


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(("git", *arguments), cwd=folder, check=True, stdout=subprocess.PIPE)
    return done.stdout.decode()


def check(only: str | None) -> bool:
    """Run the checks and the core's tests in the copy; return whether they pass."""
    # The entry points of the copy: its metadata lies before those of the installed project.
    metadata = APART / "metadata"
    install = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation")
    subprocess.run((sys.executable, *install, "--target", metadata, TREE), check=True)
    environment = {**os.environ, "PYTHONPATH": f"{TREE}{os.pathsep}{metadata}"}
    commands: list[Sequence[str]] = []
    if only != "tests":
        # The environment is that of the checkout, and is not to be made again.
        commands.append(("make", "--old-file=.venv/.developed", *CHECKS.split()))
    if only != "checks":
        tests = ("tests", f"--deselect={OF_THE_WHOLE}", "--max-worker-restart", "1")
        commands.append((sys.executable, "-m", "pytest", *PYTEST, *tests))
    return all(
        subprocess.run(command, cwd=TREE, env=environment, check=False).returncode == 0
        for command in commands
    )


def main(
    without: Annotated[list[str] | None, typer.Argument(help="Extensions; default: each.")] = None,
    *,
    at_once: Annotated[bool, typer.Option("--all", help="All of them at once.")] = False,
    only: Annotated[Literal["checks", "tests"] | None, typer.Option()] = None,
) -> None:
    """Check and test the core without extensions."""
    if unknown := sorted(set(without or ()) - set(names())):
        raise typer.BadParameter(f"no such extension: {', '.join(unknown)}")
    groups = [set(names())] if at_once else [needed_by(name) for name in without or names()]
    failed = []
    for gone in groups:
        what = "all extensions" if at_once else ", ".join(sorted(gone))
        typer.echo(f"without {what}")
        copy_without(gone)
        if not check(only):
            failed.append(what)
    for what in failed:
        typer.echo(f"fails without {what}", err=True)
    raise typer.Exit(1 if failed else 0)


if __name__ == "__main__":
    typer.run(main)

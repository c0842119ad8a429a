"""What a test found, as rows of a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import typer


@dataclass(frozen=True)
class Check:
    """One thing that must hold.

    Attributes:
        must_hold: the condition, in words.
        measured: what was found.
        holds: whether it did.
        is_speed: whether that depends on what else the machine does.
    """

    must_hold: str
    measured: str
    holds: bool
    is_speed: bool = False


def print_checks(test: str, checks: Sequence[Check]) -> None:
    """Print the rows in Markdown; exits with 1 when one does not hold."""
    typer.echo("| test | must hold | measured | holds |\n|---|---|---|---|")
    for check in checks:
        holds = "yes" if check.holds else "**no**"
        typer.echo(f"| {test} | {check.must_hold} | {check.measured} | {holds} |")
    if not all(check.holds for check in checks):
        raise typer.Exit(1)


def counts_text(counts: Counter[str]) -> str:
    """How often what was seen: ``3 x 200, 1 x 404``."""
    return ", ".join(f"{count} x {name}" for name, count in sorted(counts.items())) or "none"

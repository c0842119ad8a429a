"""Priors (``visloc.priors``) from the JSON of the API."""

from __future__ import annotations

import json
from pathlib import Path

import visloc_api.words.priors
from visloc.errors import InvalidInput, VislocError, refuse
from visloc.priors import Priors


def priors_from_text(text: str) -> Priors:
    """Parse priors as the command line has them: JSON, or the path of a file that holds it.

    Raises:
        InvalidInput: ``priors.unreadable`` for neither, and as ``priors_from_json``.
    """
    try:
        raw = json.loads(text if text.lstrip().startswith("{") else Path(text).read_bytes())
    except (OSError, ValueError) as error:
        raise refuse("priors.unreadable", field="priors", got=f"{text[:80]} ({error})") from error
    return priors_from_json(raw)


def priors_from_json(raw: object) -> Priors:
    """Make priors of the API's JSON; null is the same as left out.

    Raises:
        InvalidInput: ``request.unknown_field``, ``request.invalid``, ``priors.position``,
            ``priors.height``, ``priors.pose``, ``priors.gravity``, ``priors.maps``, or ``pose.*``.
    """
    try:
        return visloc_api.words.priors.Priors.read(raw).to_core()
    except InvalidInput as error:
        raise _named_by_prior(error) from None


def _named_by_prior(error: InvalidInput) -> VislocError:
    """Give a wrong value the code of its prior; the server names the kind of mistake."""
    field = (error.field or "").partition("[")[0]
    prior, _, part = field.removeprefix("priors.").partition(".")
    if error.code not in ("request.missing_field", "request.invalid") or not (
        part or prior == "maps"
    ):
        return error
    code = "request.invalid" if part == "device_from_world" else f"priors.{prior}"
    return refuse(code, field=field, expected=error.expected, got=error.got)

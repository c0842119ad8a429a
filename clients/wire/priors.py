"""Priors as the command line has them."""

from __future__ import annotations

import json
from pathlib import Path

import visloc.priors
from visloc.errors import refuse
from visloc_api.words.priors import Priors


def priors_from_text(text: str) -> visloc.priors.Priors:
    """Parse priors: JSON, or the path of a file that holds it.

    Raises:
        InvalidInput: ``priors.unreadable`` for neither, ``request.unknown_field``,
            ``request.invalid``, ``priors...`` or ``pose...``.
    """
    try:
        raw = json.loads(text if text.lstrip().startswith("{") else Path(text).read_bytes())
    except (OSError, ValueError) as error:
        raise refuse("priors.unreadable", field="priors", got=f"{text[:80]} ({error})") from error
    return Priors.read(raw).to_core()

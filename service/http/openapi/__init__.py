"""The content of /openapi.json: bodies, examples, problems."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any


def example(name: str, package: str = __name__) -> Any:
    """Return ``examples/NAME.json`` of a package.

    Requests can be sent as they are: their photo is grey, with 64 x 48 pixels, and their features
    are two keypoints of XFeat. Answers are those of a server, with fewer digits and photos. Names
    that end in ``_body`` are schemas of bodies.
    """
    text = files(package).joinpath("examples", f"{name}.json").read_text(encoding="utf-8")
    return json.loads(text)

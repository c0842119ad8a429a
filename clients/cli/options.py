"""Options that commands share: each is one field of a dataclass.

A command takes such a class as one parameter; ``spread`` makes an option of each of its fields.
"""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import StrEnum
from functools import cached_property, wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import typer

import visloc.priors
from clients.client import DEFAULT_TIMEOUT_S, AsyncClient, Client
from clients.evaluation.benchmark import parse_threshold
from clients.evaluation.queries import QuerySet, read_queries
from clients.evaluation.readers import Reader, choose_reader
from clients.evaluation.sent_matches import PhotoMatches
from clients.wire.options import options_from_texts
from visloc.errors import refuse
from visloc.evaluation import DEFAULT_THRESHOLDS, Threshold
from visloc.geometry import PixelOrigin
from visloc.options import PRESETS
from visloc.options import LocalizeOptions as KnownOptions
from visloc_api.words.maps import MapInfo
from visloc_api.words.options import LocalizeOptions
from visloc_api.words.priors import Priors

T = TypeVar("T")

KEY_VARIABLE = "VISLOC_API_KEY"


def spread(command: Callable[..., T]) -> Callable[..., T]:
    """Make a command for Typer: each field of a parameter that is a dataclass becomes an option."""
    groups: dict[str, type[Any]] = {}
    parameters: list[inspect.Parameter] = []
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        if is_dataclass(hints[name]):
            groups[name] = hints[name]
            parameters += _parameters_of(hints[name])
        else:
            # By keyword, so that the order of the options need not follow their defaults.
            keyword = inspect.Parameter.KEYWORD_ONLY
            parameters.append(parameter.replace(kind=keyword, annotation=hints[name]))

    @wraps(command)
    def run(**given: Any) -> T:
        for name, group in groups.items():
            given[name] = group(**{each.name: given.pop(each.name) for each in fields(group)})
        return command(**given)

    required = inspect.Parameter.empty
    parameters.sort(key=lambda each: each.default is not required)  # first in --help
    # Typer reads the signature. Type stubs of functions lack the attribute.
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _parameters_of(group: type[Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            each.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if each.default is MISSING else each.default,
            annotation=hints[each.name],
        )
        for each in fields(group)
    ]


@dataclass(frozen=True, kw_only=True)
class Connection:
    """The options of every command that asks a server."""

    server: Annotated[
        str,
        typer.Option(
            metavar="URL",
            help="http://host:port or grpc://host:port; with TLS https:// or grpcs://.",
        ),
    ] = "http://127.0.0.1:8000"
    api_key_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=f"File with the API key. Default: {KEY_VARIABLE} in the environment.",
        ),
    ] = None
    ca: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="PEM file of the certificate authorities to trust instead of the usual ones.",
        ),
    ] = None
    timeout_s: Annotated[
        float, typer.Option("--timeout", min=0.001, help="Longest wait for an answer, seconds.")
    ] = DEFAULT_TIMEOUT_S

    def client(self) -> Client:
        """Make a client."""
        return Client(self.server, api_key=self._api_key, ca=self.ca, timeout_s=self.timeout_s)

    def async_client(self) -> AsyncClient:
        """Make a client for an event loop; raises as ``client``."""
        return AsyncClient(self.server, api_key=self._api_key, ca=self.ca, timeout_s=self.timeout_s)

    @cached_property  # read once: the file may be a pipe
    def _api_key(self) -> str | None:
        # Not an option of its own: everybody on the machine can see the arguments of a command.
        if self.api_key_file is not None:
            return self.api_key_file.read_text(encoding="utf-8", errors="replace").strip()
        return os.environ.get(KEY_VARIABLE) or None


def _known_options() -> str:
    """Name the options of a query, with the words that each of them takes."""
    examples = {
        "preset": ", ".join(PRESETS),
        "fusion_weights": "such as densevlad=1,localvlad=2",
    }
    for name, hint in get_type_hints(KnownOptions).items():
        for kind in (hint, *get_args(hint)):  # also of ``Kind | None``
            if isinstance(kind, type) and issubclass(kind, StrEnum):
                examples[name] = ", ".join(kind)
    return "; ".join(
        f"{each.name} ({examples[each.name]})" if each.name in examples else each.name
        for each in fields(KnownOptions)
    )


@dataclass(frozen=True, kw_only=True)
class QueryOptions:
    """The options of every command that localizes."""

    option: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help=f"Can be repeated. Names: {_known_options()}."),
    ] = None
    seed: Annotated[int | None, typer.Option(min=0, help="The same as --option seed=...")] = None

    @property
    def options(self) -> LocalizeOptions:
        """The options of a query."""
        seed = [] if self.seed is None else [f"seed={self.seed}"]
        return options_from_texts([*(self.option or ()), *seed])


@dataclass(frozen=True, kw_only=True)
class Photos:
    """The options of every command that localizes a dataset."""

    source: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET_OR_LIST",
            help="A kapture folder, or a text file with lines 'image_name' or "
            "'image_name MODEL width height params...', or a quoted pattern of such files.",
        ),
    ]
    image_root: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The folder that the names in a list are relative to. Default: the list's.",
        ),
    ] = None
    features_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="For a map of ready-made features (kapture:TYPE): the folder of the photos' "
            "features, when they are not in the dataset.",
        ),
    ] = None
    pixel_origin: Annotated[
        PixelOrigin,
        typer.Option(
            help="Coordinates of the centre of the first pixel, in the dataset's principal "
            "points and ready-made keypoints. corner: (0.5, 0.5). center: (0, 0).",
        ),
    ] = PixelOrigin.CORNER

    def read(self) -> QuerySet:
        """Read the list of photos; raises as ``read_queries``."""
        return read_queries(self.source, self.pixel_origin, self.image_root)

    def reader(
        self,
        info: MapInfo,
        *,
        with_features_dir: bool = True,
        matches: PhotoMatches | None = None,
    ) -> Reader:
        """Choose what is sent to a map; raises as ``choose_reader``."""
        features_dir = self.features_dir if with_features_dir else None
        return choose_reader(self.source, info, features_dir, self.pixel_origin, matches)


_DEFAULT_THRESHOLDS = [
    f"{each.max_position_error_m:g}/{each.max_orientation_error_deg:g}"
    for each in DEFAULT_THRESHOLDS
]
MapRef = Annotated[str, typer.Option("--map", metavar="ID", help="id, or id@version.")]
Thresholds = Annotated[
    list[str] | None,
    typer.Option(
        "--threshold",
        metavar="METRES/DEGREES",
        help="A pose within both limits is accurate; can be repeated. Default: "
        f"{', '.join(_DEFAULT_THRESHOLDS)}.",
    ),
]


def thresholds_of(texts: Sequence[str] | None) -> Sequence[Threshold]:
    """Parse the texts of ``--threshold``."""
    return [parse_threshold(text) for text in texts or ()] or DEFAULT_THRESHOLDS


def priors_from_text(text: str) -> visloc.priors.Priors:
    """Parse priors: JSON, or the path of a file that holds it."""
    try:
        raw = json.loads(text if text.lstrip().startswith("{") else Path(text).read_bytes())
    except (OSError, ValueError) as error:
        raise refuse("priors.unreadable", field="priors", got=f"{text[:80]} ({error})") from error
    return Priors.read(raw).to_core()

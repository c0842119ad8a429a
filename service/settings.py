"""Every setting of the service, once: flag, environment, file and default, in that order.

Plain pydantic instead of pydantic-settings, which lets a misspelt ``VISLOC_`` variable pass and
cannot say where a refused value came from. This module imports nothing of visloc, so that
``main`` can set the thread counts of libraries before they are loaded.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from visloc_api.words.message import MAX_INSTANT_VALUES

PREFIX = "VISLOC_"
CONFIG_VARIABLE = "VISLOC_CONFIG"
# The clients': where the service runs too, it is no mistake.
KEY_VARIABLE = "VISLOC_API_KEY"

Port = Annotated[int, Field(ge=0, le=65535)]
Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0, le=86_400)]


def _names_of(value: object) -> object:
    if not isinstance(value, str):
        return value
    return tuple(name.strip() for name in value.split(",") if name.strip())


Names = Annotated[tuple[str, ...], BeforeValidator(_names_of)]

# Room in a request for everything but the photo.
REQUEST_OVERHEAD_BYTES = 64 * 1024
# Largest message with a piece of a packed map: 1 MiB, and a little around it.
PIECE_BYTES = 2**20 + 64 * 1024
# Room in a sequence for the numbers of one photo: its camera, a pinhole, and its share of the
# instant's. An instant of few photos needs more: odometry with its covariance, and a pose prior.
VALUES_PER_IMAGE, LEAST_PER_INSTANT = 16, 150


class SettingsError(ValueError):
    """A setting that cannot be used; the message names it and where it was given."""


class ServiceSettings(BaseModel):
    """Read once in ``main``, then passed as arguments; nothing below reads the environment."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    maps_dir: Annotated[str, BeforeValidator(str)] = "maps"
    """folder of maps, as `mapping build` writes it, or a URL of one, such as s3://bucket/maps"""
    cache_dir: Path = Path("maps-cache")
    """folder for local copies of the maps of a URL"""
    max_cache_bytes: Count = 50 * 2**30
    """room for local copies; the least recently used go first"""
    max_loaded_bytes: Count = 8 * 2**30
    """room for open maps; the least recently used are closed first"""
    max_upload_bytes: Count = 20 * 2**30
    """largest packed map that may be uploaded, bytes"""
    weights_dir: Path | None = None
    """folder of network weights, for maps whose features need them"""
    inference: Literal["auto", "int8", "fp32", "torch"] = "auto"
    """how networks are computed; auto: torch where there is a CUDA GPU, else 8 bits where the
    processor is made for them"""
    host: str = "127.0.0.1"
    """address to listen on; 0.0.0.0 serves other machines, and then needs keys_file"""
    http_port: Port = 8000
    """port of the HTTP API; 0 lets the system choose"""
    grpc_port: Port = 50051
    """port of the gRPC API; 0 lets the system choose"""
    workers: Annotated[int, Field(ge=1, le=256)] = 1
    """photos that are worked on at the same time"""
    threads_per_worker: Count = Field(
        default_factory=lambda data: max(1, (os.cpu_count() or 1) // data.get("workers", 1)),
    )
    """processor threads for one photo; default: cores / workers"""
    keys_file: Path | None = None
    """API keys, as `python -m service.keys` writes them; without, whoever reaches the service may
    do everything, so that it listens on this machine only"""
    tls_cert: Path | None = None
    """PEM file of the certificate chain: HTTPS and gRPC over TLS"""
    tls_key: Path | None = None
    """PEM file of the certificate's private key"""
    cors_origins: Names = ()
    """comma-separated origins of web pages that may call the HTTP API; none by default"""
    page: bool = True
    """whether / is a web page that shows maps and localizes photos; its files need no key"""
    metrics_port: Port | None = None
    """a port of its own for /metrics, without a key, for a scraper in a private network"""
    max_queue: Annotated[int, Field(ge=0)] = 64
    """photos that may wait for a worker; beyond it a request is refused"""
    max_connections: Count = 1000
    """connections that HTTP and gRPC each have open at once, and calls of gRPC; for one more, the
    longest idle is closed, by gRPC from three quarters on. Lowered where the system allows too few
    open files"""
    max_buffered_bytes: Count = 512 * 2**20
    """bytes of requests held while they arrive; beyond it a request is refused"""
    request_timeout_s: Seconds = 60.0
    """longest time from when a request has arrived to its answer; callers may ask for less.
    Sequences: to the next answer"""
    arrival_timeout_s: Seconds = 20.0
    """longest time for the head of a request to arrive, and for its body, to which a second is
    added for every 100 kB; also the longest silence within a stream"""
    drain_delay_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """time after SIGTERM in which new requests are still taken, and /readyz says no already: for
    balancers to notice"""
    drain_timeout_s: Seconds = 30.0
    """time for running requests to end after SIGTERM"""
    max_image_bytes: Count = 20 * 2**20
    """largest encoded photo, bytes"""
    max_image_pixels: Count = 50_000_000
    """largest photo, width times height"""
    max_batches: Count = 8
    """rigs and sequences that are served at once; one more is refused"""
    max_batch_bytes: Count = 64 * 2**20
    """largest request with several photos, bytes: over HTTP as it comes, base64 included; over gRPC
    one message, that is a rig's photos or those of one instant of a sequence"""
    max_rig_images: Count = 16
    """photos of one instant of a rig"""
    max_instants: Count = 1000
    """instants of one sequence"""
    log_format: Literal["text", "json"] = "text"
    """how it is logged: lines for people, or one JSON object per line"""
    otlp_endpoint: str | None = None
    """URL of an OpenTelemetry collector (OTLP over HTTP) that gets spans"""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """what is logged to stderr: debug, info, warning or error"""

    @property
    def max_request_bytes(self) -> int:
        """Largest request that carries one photo as it is: multipart and gRPC."""
        return self.max_image_bytes + REQUEST_OVERHEAD_BYTES

    @property
    def max_json_bytes(self) -> int:
        """Largest request with one photo in JSON: base64 makes four bytes of three."""
        return self.max_image_bytes * 4 // 3 + REQUEST_OVERHEAD_BYTES

    @property
    def max_message_bytes(self) -> int:
        """Largest message of gRPC: of one photo, an instant's, or a piece of a packed map."""
        return max(self.max_request_bytes, self.max_batch_bytes, PIECE_BYTES)

    @property
    def max_sequence_values(self) -> int:
        """Values in the JSON of a sequence: each takes about a microsecond and 100 bytes."""
        per_instant = max(LEAST_PER_INSTANT, VALUES_PER_IMAGE * (self.max_rig_images + 1))
        return max(MAX_INSTANT_VALUES, per_instant * (self.max_instants + 1))


def read_settings(arguments: Sequence[str], environment: Mapping[str, str]) -> ServiceSettings:
    """Merge flags, ``VISLOC_`` variables, the file that ``--config`` names, and defaults.

    Raises:
        SettingsError: for an unknown name or a value that cannot be used.
        SystemExit: from argparse, for ``--help`` and unknown flags.
    """
    flags = vars(_parser().parse_args(arguments))
    file = flags.pop("config", environment.get(CONFIG_VARIABLE) or None)
    variables = _from_environment(environment)
    in_file = {} if file is None else _from_file(Path(file))
    try:
        return ServiceSettings.model_validate({**in_file, **variables, **flags})
    except ValidationError as refused:
        first = refused.errors(include_url=False)[0]
        name = str(first["loc"][0])
        source = (
            _flag(name) if name in flags else _variable(name) if name in variables else str(file)
        )
        raise SettingsError(
            f"{source}: {name} cannot be {first['input']!r}: {first['msg']}"
        ) from None


def _from_environment(environment: Mapping[str, str]) -> dict[str, str]:
    # An empty variable counts as absent, as compose files leave them behind.
    variables = {
        name: value for name, value in environment.items() if name.startswith(PREFIX) and value
    }
    for name in (CONFIG_VARIABLE, KEY_VARIABLE):
        variables.pop(name, None)
    known = {_variable(name): name for name in ServiceSettings.model_fields}
    _refuse_unknown(variables, known, "environment")
    return {known[name]: value for name, value in variables.items()}


def _from_file(path: Path) -> dict[str, object]:
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"{path}: the file of settings cannot be read: {error}") from None
    except ValueError as error:  # of TOML and of UTF-8
        raise SettingsError(f"{path}: not a TOML file: {error}") from None
    _refuse_unknown(values, ServiceSettings.model_fields, str(path))
    return values


def _refuse_unknown(given: Iterable[str], known: Iterable[str], source: str) -> None:
    names = sorted(known)
    for name in given:
        if name not in names:
            close = get_close_matches(name, names, n=2) or names
            raise SettingsError(f"{source}: unknown setting {name}; known: {', '.join(close)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m service",
        description="Serve maps: localize photos over HTTP and gRPC.",
        epilog=f"Every flag is also an environment variable ({_variable('maps_dir')} for "
        f"{_flag('maps_dir')}) and a key of the --config file (maps_dir). "
        "Order: flag, environment, file, default.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--config",
        metavar="FILE",
        default=argparse.SUPPRESS,
        help=f"TOML file with settings (also {CONFIG_VARIABLE})",
    )
    for name, field in ServiceSettings.model_fields.items():
        default = "" if field.default_factory else f" (default: {field.default})"
        parser.add_argument(
            _flag(name),
            dest=name,
            metavar="N" if field.annotation is int else name.rsplit("_", 1)[-1].upper(),
            default=argparse.SUPPRESS,
            help=f"{field.description}{'' if field.default is None else default}",
        )
    return parser


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _variable(name: str) -> str:
    return PREFIX + name.upper()

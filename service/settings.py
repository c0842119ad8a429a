"""All settings of the service. Precedence: flag, environment, file, default.

This is plain pydantic: pydantic-settings accepts misspelt ``VISLOC_`` variables and cannot say
where a refused value came from. This module imports nothing of visloc, so that ``main`` can set the
thread counts of libraries before they are loaded.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from service.machine import memory_limit, usable_cores

PREFIX = "VISLOC_"
CONFIG_VARIABLE = "VISLOC_CONFIG"
# Belongs to the clients, which may run in the same environment.
KEY_VARIABLE = "VISLOC_API_KEY"

Port = Annotated[int, Field(ge=0, le=65535)]
Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0, le=86_400)]


def _names_of(value: object) -> object:
    if not isinstance(value, str):
        return value
    return tuple(name.strip() for name in value.split(",") if name.strip())


Names = Annotated[tuple[str, ...], BeforeValidator(_names_of)]

# Room in a request for everything except the photo.
REQUEST_OVERHEAD_BYTES = 64 * 1024
# The largest message with a piece of a packed map: 1 MiB and some overhead.
PIECE_BYTES = 2**20 + 64 * 1024
# Clients that send or take less than this are disconnected after ``arrival_timeout_s``.
SLOWEST_BYTES_PER_S = 100_000


_MOST_WORKERS = 256
# With maps of the usual features; those of the map itself are files, which all workers share.
_BYTES_PER_WORKER = 2**30


class SettingsError(ValueError):
    """A setting that cannot be used; the message names it and its source."""


class ServiceSettings(BaseModel):
    """Read once in ``main`` and passed on; nothing else reads the environment."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    maps_dir: Annotated[str, BeforeValidator(str)] = "maps"
    """folder of maps that `mapping build` wrote, or its URL, such as s3://bucket/maps"""
    cache_dir: Path = Path("maps-cache")
    """folder for local copies of maps, when maps_dir is a URL"""
    max_cache_bytes: Count = 50 * 2**30
    """limit of the local copies, bytes; the least recently used are deleted first"""
    max_loaded_bytes: Count = 8 * 2**30
    """limit of the open maps of each worker, bytes; the least recently used are closed first"""
    max_upload_bytes: Count = 20 * 2**30
    """largest packed map accepted for upload, bytes"""
    weights_dir: Path | None = None
    """folder of network weights, for maps whose features need them"""
    inference: Literal["auto", "int8", "fp32", "torch"] = "auto"
    """how networks run; auto: torch on a CUDA GPU, else int8 on processors with instructions for
    it, else fp32"""
    host: str = "127.0.0.1"
    """address to listen on; addresses that other machines reach, such as 0.0.0.0, need keys_file"""
    http_port: Port = 8000
    """port of the HTTP API; 0 picks a free one"""
    grpc_port: Port = 50051
    """port of the gRPC API; 0 picks a free one"""
    workers: Annotated[int, Field(ge=1, le=_MOST_WORKERS)] = Field(
        default_factory=lambda: default_workers()
    )
    """worker processes; each localizes one photo at a time; default: one for each core, as far as
    there is 1 GiB of memory for each"""
    threads_per_worker: Count = Field(default_factory=lambda: usable_cores())
    """most processor threads for one photo; photos that are localized at the same time share the
    cores; default: cores"""
    keys_file: Path | None = None
    """file of API keys that `python -m service.keys` wrote; without keys, the service
    accepts only callers on this machine, and lets them do everything"""
    tls_cert: Path | None = None
    """PEM file of the certificate chain; turns on TLS for HTTP and gRPC"""
    tls_key: Path | None = None
    """PEM file of the certificate's private key"""
    cors_origins: Names = ()
    """comma-separated origins of other web pages that may call the HTTP API; none by default"""
    trusted_proxies: Names = ()
    """comma-separated addresses or networks of proxies; the log takes the address of their callers
    from X-Forwarded-For"""
    page: bool = True
    """whether to serve the web page at /, which shows maps and localizes photos; its files need no
    key"""
    metrics_port: Port | None = None
    """separate port for /metrics that needs no key, for Prometheus in a private network"""
    max_queue: Annotated[int, Field(ge=0)] = 64
    """photos that may wait for a worker; further requests are refused"""
    max_connections: Count = 1000
    """limit of open HTTP connections, of open gRPC connections, and of running gRPC calls; further
    ones are closed or refused. The limit is lowered if the system allows too few open files"""
    max_buffered_bytes: Count = 512 * 2**20
    """memory for requests that are arriving, bytes; further requests are refused"""
    request_timeout_s: Seconds = 60.0
    """longest time from the arrival of a request to its answer, or to the next answer of a
    sequence; callers may ask for less"""
    arrival_timeout_s: Seconds = 20.0
    """longest time for the body of a request to arrive, plus a second for every 100 kB of it; also
    the longest silence within a stream, and until a client takes something of its answer"""
    drain_delay_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """time after SIGTERM during which /readyz already says no but new requests are still served,
    so that load balancers notice"""
    drain_timeout_s: Seconds = 30.0
    """time for running requests to finish after SIGTERM"""
    max_image_bytes: Count = 20 * 2**20
    """largest encoded photo, bytes"""
    max_image_pixels: Count = 50_000_000
    """largest photo, width times height in pixels"""
    max_batches: Count = 8
    """rigs and sequences served at once; further ones are refused"""
    max_batch_bytes: Count = 64 * 2**20
    """largest request with several photos, bytes; over HTTP the whole body, base64 included; over
    gRPC one message: the photos of a rig, or of one instant of a sequence"""
    max_rig_images: Count = 16
    """photos per instant"""
    max_instants: Count = 1000
    """instants per sequence"""
    log_format: Literal["text", "json"] = "text"
    """format of the log: lines for people, or one JSON object per line"""
    otlp_endpoint: str | None = None
    """URL of an OpenTelemetry collector for spans (OTLP over HTTP)"""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """least severe level that is logged to stderr: debug, info, warning or error"""

    @property
    def max_request_bytes(self) -> int:
        """Largest request with one photo in binary form: multipart or gRPC."""
        return self.max_image_bytes + REQUEST_OVERHEAD_BYTES

    @property
    def max_json_bytes(self) -> int:
        """Largest request with one photo in JSON, where base64 turns 3 bytes into 4."""
        return self.max_image_bytes * 4 // 3 + REQUEST_OVERHEAD_BYTES

    @property
    def max_message_bytes(self) -> int:
        """Largest gRPC message: one photo, one instant, or a piece of a packed map."""
        return max(self.max_request_bytes, self.max_batch_bytes, PIECE_BYTES)


def default_workers() -> int:
    """Return how many worker processes keep all cores busy and fit the memory."""
    memory = memory_limit()
    fitting = _MOST_WORKERS if memory is None else memory // _BYTES_PER_WORKER
    return max(1, min(usable_cores(), fitting, _MOST_WORKERS))


def read_settings(arguments: Sequence[str], environment: Mapping[str, str]) -> ServiceSettings:
    """Merge flags, ``VISLOC_`` variables, the file that ``--config`` names, and defaults."""
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
    # An empty variable counts as absent: compose files set them.
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
    except ValueError as error:  # no TOML, no UTF-8
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
        has_default = field.default_factory is None and field.default not in (None, ())
        parser.add_argument(
            _flag(name),
            dest=name,
            metavar="N" if field.annotation is int else name.rsplit("_", 1)[-1].upper(),
            default=argparse.SUPPRESS,
            help=str(field.description) + (f" (default: {field.default})" if has_default else ""),
        )
    return parser


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _variable(name: str) -> str:
    return PREFIX + name.upper()

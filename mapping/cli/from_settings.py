"""Command lines made from settings: one option for each field that says its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any, TypeGuard, get_args, get_origin, get_type_hints

from mapping.options import OnCommandLine


def from_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command for Typer that takes options and calls ``command`` with settings.

    A parameter that is a dataclass becomes the options of its fields, and so on inwards. A field
    without a ``typer.Option`` or ``typer.Argument`` keeps its default. Other parameters are options
    as Typer has them, with ``OnCommandLine`` heeded.
    """
    options = {option.name: option for option in _options(command)}

    @wraps(command)
    def run(**given: Any) -> None:
        _call(command, given)

    # Typer reads the signature. Type stubs of functions lack the attribute.
    run.__signature__ = Signature([*options.values()])  # type: ignore[attr-defined]
    run.__annotations__ = {name: option.annotation for name, option in options.items()}
    return run


def _options(holder: Callable[..., Any]) -> Iterator[Parameter]:
    """The options of a command's parameters or of a dataclass's fields."""
    for parameter, base, metadata in _parameters(holder):
        if _is_settings(base):
            yield from _options(base)
        elif metadata:
            yield _option(parameter, base, metadata)


def _parameters(holder: Callable[..., Any]) -> Iterator[tuple[Parameter, Any, tuple[Any, ...]]]:
    hints = get_type_hints(holder, include_extras=True)
    for name, parameter in signature(holder).parameters.items():
        base, *metadata = (
            get_args(hints[name]) if get_origin(hints[name]) is Annotated else (hints[name],)
        )
        yield parameter, base, tuple(metadata)


def _is_settings(base: Any) -> TypeGuard[type]:
    return isinstance(base, type) and is_dataclass(base)


def _option(parameter: Parameter, base: Any, metadata: tuple[Any, ...]) -> Parameter:
    default, line = parameter.default, _on_command_line(metadata)
    if line.default is not None:
        default = line.default
    if line.parse is not None:
        base = str | None if default is None else str
        if default not in (None, Parameter.empty):
            default = line.write(default)
    others = [one for one in metadata if not isinstance(one, OnCommandLine)]
    return Parameter(
        parameter.name,
        Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[base, *others],
    )


def _call(holder: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Call a command, or make a dataclass, with what the command line gave."""
    values = {}
    for parameter, base, metadata in _parameters(holder):
        name = parameter.name
        if _is_settings(base):
            values[name] = _call(base, given)
        elif name in given:
            parse, value = _on_command_line(metadata).parse, given[name]
            values[name] = value if parse is None or value is None else parse(value)
    return holder(**values)


def _on_command_line(metadata: tuple[Any, ...]) -> OnCommandLine:
    return next((one for one in metadata if isinstance(one, OnCommandLine)), OnCommandLine())

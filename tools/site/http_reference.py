"""The reference of the HTTP API, from the service's own OpenAPI description."""

from __future__ import annotations

import json
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

from service.http.app import create_app
from service.http.envelope import Backend
from service.settings import read_settings

Schema = dict[str, Any]


def http_reference() -> str:
    """Return Markdown: a section for each route, then a table for each schema."""
    schema = openapi_schema()
    lines = ["## Routes", ""]
    for path, methods in schema["paths"].items():
        for method, operation in methods.items():
            lines += _route(method.upper(), path, operation)
    lines += ["## Schemas", ""]
    for name, model in sorted(schema["components"]["schemas"].items()):
        lines += _model(name, model)
    return "\n".join(lines)


def openapi_schema() -> Schema:
    """Return the description that a service with the default settings serves."""
    # The routes take from the backend only what decides which of them there are.
    settings = read_settings([], {}).model_copy(update={"page": False})
    access = SimpleNamespace(origins=())
    backend = SimpleNamespace(settings=settings, access=access, observer=None)
    return create_app(cast(Backend, backend)).openapi()


def _route(method: str, path: str, operation: Schema) -> Iterator[str]:
    yield from (f"### {method} {path}", "", operation.get("description", ""), "")
    if parameters := operation.get("parameters"):
        yield from ("| parameter | in | type | |", "|---|---|---|---|")
        for each in parameters:
            about = _cell(each.get("description", ""))
            yield f"| `{each['name']}` | {each['in']} | {_type(each['schema'])} | {about} |"
        yield ""
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        yield from (f"Body, `{kind}`: {_type(content['schema'])}", "")
        yield from _fields(content["schema"])
        yield from _examples(content)
    yield from ("| status | | body |", "|---|---|---|")
    for status, response in operation["responses"].items():
        bodies = "<br>".join(
            f"`{kind}`: {_type(content.get('schema', {}))}"
            for kind, content in response.get("content", {}).items()
        )
        yield f"| {status} | {_cell(response['description'])} | {bodies} |"
    yield ""
    for content in operation["responses"].get("200", {}).get("content", {}).values():
        yield from _examples(content)


def _examples(content: Schema) -> Iterator[str]:
    for name, example in content.get("examples", {}).items():
        shown = json.dumps(example["value"], indent=2)
        yield from (f"Example, *{name}*:", "", "```json", shown, "```", "")


def _model(name: str, model: Schema) -> Iterator[str]:
    yield from (f"### {name}", "", model.get("description", ""), "")
    if "enum" in model:
        yield from ("One of " + ", ".join(f"`{word}`" for word in model["enum"]) + ".", "")
    yield from _fields(model)


def _fields(model: Schema) -> Iterator[str]:
    if "properties" not in model:
        return
    required = model.get("required", ())
    yield from ("| field | type | default | |", "|---|---|---|---|")
    for field, schema in model["properties"].items():
        default = "required" if field in required else f"`{json.dumps(schema.get('default'))}`"
        about = _cell(schema.get("description", ""))
        yield f"| `{field}` | {_type(schema)} | {default} | {about} |"
    yield ""


def _type(schema: Schema) -> str:
    """Name a type in a table's cell, with links to the schemas that have a section."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    for key in ("anyOf", "oneOf"):
        if key in schema:
            kinds = (_type(each) for each in schema[key] if each.get("type") != "null")
            return " or ".join(dict.fromkeys(kinds))
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return ", ".join(f"`{word}`" for word in schema["enum"])
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {})) or 'values'}"
    if (
        isinstance(values := schema.get("additionalProperties"), dict)
        and "properties" not in schema
    ):
        return f"object of {_type(values)} by name"
    return str(schema.get("type", ""))


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")

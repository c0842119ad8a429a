"""The reference of the gRPC API, from the comments of its proto."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
    ServiceDescriptorProto,
)
from grpc_tools import protoc

ROOT = Path(__file__).resolve().parents[2]
PROTO = "visloc_api/v1/localization.proto"
# Field numbers of descriptor.proto, of which the paths of comments are made.
_MESSAGES, _SERVICES, _MEMBERS = 4, 6, 2

Comments = dict[tuple[int, ...], str]


def grpc_reference() -> str:
    """Return Markdown: a section for each service, then a table for each message."""
    file = _described()
    comments = {
        tuple(place.path): " ".join((place.leading_comments or place.trailing_comments).split())
        for place in file.source_code_info.location
    }
    lines: list[str] = []
    for number, service in enumerate(file.service):
        lines += _service(service, comments, (_SERVICES, number))
    lines += ["## Messages", ""]
    for number, message in enumerate(file.message_type):
        lines += _message(message, comments, (_MESSAGES, number))
    return "\n".join(lines)


def _described() -> FileDescriptorProto:
    with TemporaryDirectory() as folder:
        target = Path(folder) / "described"
        arguments = ("protoc", f"--proto_path={ROOT / 'proto'}", "--include_source_info")
        if protoc.main([*arguments, f"--descriptor_set_out={target}", PROTO]):
            raise ValueError(f"protoc cannot read {PROTO}")
        return FileDescriptorSet.FromString(target.read_bytes()).file[0]


def _service(
    service: ServiceDescriptorProto, comments: Comments, path: Sequence[int]
) -> Iterator[str]:
    yield from (f"## {service.name}", "", comments.get((*path,), ""), "")
    for number, method in enumerate(service.method):
        takes = ("stream of " if method.client_streaming else "") + _link(method.input_type)
        gives = ("stream of " if method.server_streaming else "") + _link(method.output_type)
        yield from (f"### {service.name}.{method.name}", "", f"{takes} → {gives}", "")
        yield from (comments.get((*path, _MEMBERS, number), ""), "")


def _message(message: DescriptorProto, comments: Comments, path: Sequence[int]) -> Iterator[str]:
    yield from (f"### {message.name}", "", comments.get((*path,), ""), "")
    if not message.field:
        return
    entries = {entry.name: entry for entry in message.nested_type if entry.options.map_entry}
    yield from ("| field | number | type | |", "|---|---|---|---|")
    for number, field in enumerate(message.field):
        entry = entries.get(field.type_name.rpartition(".")[2])
        kind = f"{_kind(entry.field[1])} by {_kind(entry.field[0])}" if entry else _kind(field)
        if not entry and field.label == FieldDescriptorProto.LABEL_REPEATED:
            kind = f"list of {kind}"
        if field.proto3_optional:
            kind += ", optional"
        about = comments.get((*path, _MEMBERS, number), "").replace("|", "\\|")
        yield f"| `{field.name}` | {field.number} | {kind} | {about} |"
    yield ""


def _kind(field: FieldDescriptorProto) -> str:
    if field.type_name:
        return _link(field.type_name)
    return FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()


def _link(full_name: str) -> str:
    name = full_name.rpartition(".")[2]
    return f"[{name}](#{name.lower()})"

"""The log's protobuf messages, made from the .proto files beside this one at run time, without protoc."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

Field = descriptor_pb2.FieldDescriptorProto
SCALAR_TYPES = {
    "double": Field.TYPE_DOUBLE, "int32": Field.TYPE_INT32, "int64": Field.TYPE_INT64, "sint64": Field.TYPE_SINT64,
    "uint32": Field.TYPE_UINT32, "bool": Field.TYPE_BOOL, "string": Field.TYPE_STRING, "bytes": Field.TYPE_BYTES,
}  # fmt: skip
FIELD_LINE = re.compile(r"(?:(optional|repeated)\s+)?([\w.]+)\s+(\w+)\s*=\s*(\d+)\s*;")
TIMESTAMP_PROTO = "google/protobuf/timestamp.proto"

FLOAT64_MULTI_ARRAY = """\
MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""


def parse_proto(name: str, text: str) -> descriptor_pb2.FileDescriptorProto:
    """The descriptor of a .proto file in the subset that the head of log_schema.proto names, and flat enums."""
    text = re.sub(r"//[^\n]*", "", text)
    package = re.findall(r"^package\s+([\w.]+);", text, re.M)[0]
    file = descriptor_pb2.FileDescriptorProto(name=name, package=package, syntax="proto3")
    if TIMESTAMP_PROTO in text:
        file.dependency.append(TIMESTAMP_PROTO)
    enums = dict(re.findall(r"enum\s+(\w+)\s*\{([^}]*)\}", text))
    for title, body in enums.items():
        enum = file.enum_type.add(name=title)
        for value, number in re.findall(r"(\w+)\s*=\s*(\d+)\s*;", body):
            enum.value.add(name=value, number=int(number))
    for title, body in re.findall(r"message\s+(\w+)\s*\{([^}]*)\}", text):
        message = file.message_type.add(name=title)
        for label, kind, field_name, number in FIELD_LINE.findall(body):
            field = message.field.add(name=field_name, number=int(number))
            field.label = Field.LABEL_REPEATED if label == "repeated" else Field.LABEL_OPTIONAL
            if kind in SCALAR_TYPES:
                field.type = SCALAR_TYPES[kind]
            else:
                field.type = Field.TYPE_ENUM if kind in enums else Field.TYPE_MESSAGE
                field.type_name = f".{kind}" if "." in kind else f".{package}.{kind}"
            if label == "optional":  # proto3 presence is a synthetic oneof of one
                field.proto3_optional = True
                field.oneof_index = len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{field_name}")
    return file


@cache
def files() -> tuple[descriptor_pb2.FileDescriptorProto, ...]:
    folder = Path(__file__).parent
    names = ("log_schema.proto", "foxglove_log.proto")
    return tuple(parse_proto(name, (folder / name).read_text("utf-8")) for name in names)


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    pool = descriptor_pool.DescriptorPool()  # our own: other libraries may register a foxglove.Log too
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    for file in (timestamp, *files()):
        pool.Add(file)
    return pool


@cache
def message(full_name: str) -> Any:
    """The message class of "rotorscope.Block", "foxglove.Log" and so on."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(full_name))


@cache
def descriptor_set(full_name: str) -> bytes:
    """The FileDescriptorSet that an MCAP schema record of this message carries."""
    own = next(f for f in files() if f.package == full_name.rpartition(".")[0])
    out = descriptor_pb2.FileDescriptorSet()
    if own.dependency:
        timestamp_pb2.DESCRIPTOR.CopyToProto(out.file.add())
    out.file.append(own)
    return out.SerializeToString()

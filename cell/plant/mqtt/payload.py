"""Payloads of Sparkplug B: metrics as protobuf, by the field numbers of its specification.

source  Sparkplug 3.0.0, 6.4.1 Google Protocol Buffer Schema, 6.4.16 Data Types
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

Value = bool | int | float | str | None

_FIELD = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "cell_sparkplug"


class DataType(IntEnum):
    """Type of a metric, and the value's field in which it is sent."""

    INT64 = 4
    UINT64 = 8
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12
    DATE_TIME = 13


_VALUE_FIELDS = {
    DataType.INT64: "long_value",
    DataType.UINT64: "long_value",
    DataType.DOUBLE: "double_value",
    DataType.BOOLEAN: "boolean_value",
    DataType.STRING: "string_value",
    DataType.DATE_TIME: "long_value",
}

#: Fields of a message: name, number, type.  Metrics of other types are never sent, and are skipped
#: when they are read.
_METRIC = (
    ("name", 1, _FIELD.TYPE_STRING),
    ("alias", 2, _FIELD.TYPE_UINT64),
    ("timestamp", 3, _FIELD.TYPE_UINT64),
    ("datatype", 4, _FIELD.TYPE_UINT32),
    ("is_historical", 5, _FIELD.TYPE_BOOL),
    ("is_null", 7, _FIELD.TYPE_BOOL),
    ("int_value", 10, _FIELD.TYPE_UINT32),
    ("long_value", 11, _FIELD.TYPE_UINT64),
    ("float_value", 12, _FIELD.TYPE_FLOAT),
    ("double_value", 13, _FIELD.TYPE_DOUBLE),
    ("boolean_value", 14, _FIELD.TYPE_BOOL),
    ("string_value", 15, _FIELD.TYPE_STRING),
)
_FIRST_VALUE = 10
_PAYLOAD = (
    ("timestamp", 1, _FIELD.TYPE_UINT64),
    ("metrics", 2, _FIELD.TYPE_MESSAGE),
    ("seq", 3, _FIELD.TYPE_UINT64),
)


@dataclass(frozen=True)
class Metric:
    """One value that is sent.

    name           as in the birth; None = only its alias is sent
    time_ms        when it was so, Unix time, ms
    is_historical  whether it is told late and is not the present value
    """

    name: str | None
    kind: DataType
    value: Value
    time_ms: int
    alias: int | None = None
    is_historical: bool = False


def _payload_class() -> Any:
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}.proto", package=_PACKAGE, syntax="proto2"
    )
    metric = file.message_type.add(name="Metric")
    metric.oneof_decl.add(name="value")
    for name, number, kind in _METRIC:
        field = metric.field.add(name=name, number=number, type=kind, label=_FIELD.LABEL_OPTIONAL)
        if number >= _FIRST_VALUE:
            field.oneof_index = 0
    payload = file.message_type.add(name="Payload")
    for name, number, kind in _PAYLOAD:
        field = payload.field.add(name=name, number=number, type=kind, label=_FIELD.LABEL_OPTIONAL)
        if kind == _FIELD.TYPE_MESSAGE:
            field.label, field.type_name = _FIELD.LABEL_REPEATED, f".{_PACKAGE}.Metric"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.Payload"))


_Payload = _payload_class()


def encode(metrics: Iterable[Metric], time_ms: int, seq: int | None) -> bytes:
    """Metrics as a payload.

    time_ms  when it is sent, Unix time, ms
    seq      number of the message, 0 to 255; None = it has none
    """
    payload = _Payload(timestamp=time_ms)
    if seq is not None:
        payload.seq = seq
    for metric in metrics:
        sent = payload.metrics.add(timestamp=metric.time_ms, datatype=int(metric.kind))
        if metric.name is not None:
            sent.name = metric.name
        if metric.alias is not None:
            sent.alias = metric.alias
        if metric.is_historical:
            sent.is_historical = True
        if metric.value is None:
            sent.is_null = True
        else:
            setattr(sent, _VALUE_FIELDS[metric.kind], metric.value)
    return bytes(payload.SerializeToString())


def flags(payload: bytes) -> dict[str, bool]:
    """Metrics of a payload that are true or false, by name.

    raises  ValueError: it is no payload
    """
    try:
        read = _Payload.FromString(payload)
    except DecodeError as error:
        raise ValueError(f"no payload of Sparkplug B: {error}") from error
    return {
        str(metric.name): bool(metric.boolean_value)
        for metric in read.metrics
        if metric.HasField("boolean_value")
    }

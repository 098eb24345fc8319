"""The cell as an edge node of Sparkplug B: births, deaths and data.

source  Sparkplug 3.0.0, chapters 4 to 6
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from cell.files.plain import plain
from cell.plant.messages import MessageKind, Notice, Status
from cell.plant.mqtt.form import EndOfSessionError, Message, PublishedState
from cell.records.result import Outcome
from cell.run.machine import CellState

Value = bool | int | float | str | None

_FIELD = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "cell_sparkplug"


class DataType(IntEnum):
    """Type of a metric, and the field of the payload that holds its value."""

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
    """One value of a payload.

    name           as in the birth; None = only its alias is sent
    time_ms        when it was so, Unix time, ms
    is_historical  whether it is sent late and is not the present value
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
    """Payload that contains the metrics.

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
    """Boolean metrics of a payload, by name.

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


_NAMESPACE = "spBv1.0"
REBIRTH = "Node Control/Rebirth"
#: Births, deaths and numbers of messages are counted modulo this.
_COUNTED = 256

_T = DataType
#: Of a result, as metrics of their own; `Result/JSON` has all of it.
_RESULT_NUMBERS = (
    *("offset_m", "predicted_miss_m", "measured_miss_m", "margin_m", "probability"),
    *("prediction_error_m", "wait_s"),
)
_FAULT_TEXTS = ("step", "cause", "device", "remedy", "cable", "code")

#: All metrics that a cell ever sends, in the order of their aliases, which count from 1.
METRICS: dict[str, DataType] = {
    "Cell/Connected": _T.BOOLEAN,
    "Cell/State": _T.STRING,
    "Cell/Since": _T.DATE_TIME,
    "Cell/Mode": _T.STRING,
    "Cell/Step": _T.STRING,
    "Cell/Cycle": _T.UINT64,
    "Cell/Part": _T.STRING,
    "Cell/Product": _T.STRING,
    "Cell/Waiting for": _T.STRING,
    "Cell/Model": _T.STRING,
    "Cell/Software": _T.STRING,
    "Cell/Dropped": _T.UINT64,
    **{f"Counts/{outcome.value}": _T.UINT64 for outcome in Outcome},
    **{f"Seconds/{state.value}": _T.DOUBLE for state in CellState},
    "Fault/cycle": _T.UINT64,
    "Fault/time": _T.DATE_TIME,
    **{f"Fault/{name}": _T.STRING for name in _FAULT_TEXTS},
    "Acknowledged/by": _T.STRING,
    "Acknowledged/note": _T.STRING,
    "Result/cycle": _T.UINT64,
    "Result/outcome": _T.STRING,
    "Result/part": _T.STRING,
    "Result/reason": _T.STRING,
    **{f"Result/{name}": _T.DOUBLE for name in _RESULT_NUMBERS},
    "Result/JSON": _T.STRING,
    "Notice/run": _T.STRING,
    "Notice/sequence": _T.UINT64,
}
_ALIASES = {name: alias for alias, name in enumerate(METRICS, 1)}


class EdgeNode:
    """Form of messages after Sparkplug B.

    group, node   ids
    births        connections that were begun before this one, which tells its death from others'
    primary_host  id of the host without which nothing is sent; None = there is none
    """

    def __init__(self, group: str, node: str, births: int, primary_host: str | None = None) -> None:
        self._group, self._node = group, node
        self._bd_seq = births % _COUNTED
        self._seq = 0
        self._sent: dict[str, Value] = {}
        self._contained: tuple[str, int] | None = None
        self._host = None if primary_host is None else f"{_NAMESPACE}/STATE/{primary_host}"
        self._host_since = -1
        self._host_online = False
        self.subscriptions: Sequence[str] = (
            self._topic("NCMD"),
            *([] if self._host is None else [self._host]),
        )

    def will(self) -> Message:
        """The death certificate."""
        return Message(self._topic("NDEATH"), encode([self._bd()], _now_ms(), None), 1)

    def can_publish(self) -> bool:
        """Whether the primary host, if there is one, is online."""
        return self._host is None or self._host_online

    def birth(self, known: PublishedState) -> list[Message]:
        """All metrics with names, aliases and values."""
        self._seq = 0
        self._sent = dict.fromkeys(METRICS) | self._values(known)
        at_ms = _now_ms()
        metrics = [
            self._bd(),
            Metric(REBIRTH, _T.BOOLEAN, False, at_ms),
            *(
                Metric(name, kind, self._sent[name], at_ms, _ALIASES[name])
                for name, kind in METRICS.items()
            ),
        ]
        return [Message(self._topic("NBIRTH"), encode(metrics, at_ms, self._seq), 0)]

    def of_notice(self, notice: Notice) -> list[Message]:
        """Metrics of a notice; historical if a later birth contains them already."""
        late = self._contained is not None and (
            notice.run != self._contained[0] or notice.sequence <= self._contained[1]
        )
        values = _values_of(notice)
        values |= {"Notice/run": notice.run, "Notice/sequence": notice.sequence}
        if not late:
            self._sent |= values
        return [self._data(values, round(1000 * notice.time_s), late)]

    def of_status(self, known: PublishedState) -> list[Message]:
        """Metrics that have changed."""
        values = self._values(known)
        changed = {name: value for name, value in values.items() if self._sent[name] != value}
        if not changed:
            return []
        self._sent |= changed
        return [self._data(changed, _now_ms(), False)]

    def farewell(self, known: PublishedState) -> list[Message]:
        """The death certificate, sent by the adapter itself."""
        return [self.will()]

    def receive(self, topic: str, payload: bytes) -> bool:
        """A command for a rebirth, the only one that is obeyed; or the state of the host.

        raises  EndOfSessionError: the primary host goes offline
        """
        if topic == self._topic("NCMD"):
            try:
                return flags(payload).get(REBIRTH, False)
            except ValueError:
                return False
        if topic == self._host:
            self._receive_host_state(payload)
        return False

    def _receive_host_state(self, payload: bytes) -> None:
        try:
            state = json.loads(payload)
            online, since = state["online"] is True, int(state["timestamp"])
        except (ValueError, KeyError, TypeError):
            return
        if since < self._host_since:
            return
        was_online, self._host_online, self._host_since = self._host_online, online, since
        if was_online and not online:
            raise EndOfSessionError("the primary host is offline")

    def _values(self, known: PublishedState) -> dict[str, Value]:
        """Values of a status; those of a cell that was never reached are unknown."""
        values: dict[str, Value] = {
            "Cell/Connected": known.is_cell,
            "Cell/Dropped": known.dropped,
        }
        if known.status is not None:
            self._contained = (known.status.run, known.status.sequence)
            values |= _values_of_status(known.status)
        return values

    def _data(self, values: Mapping[str, Value], time_ms: int, late: bool) -> Message:
        self._seq = (self._seq + 1) % _COUNTED
        metrics = [
            Metric(None, METRICS[name], value, time_ms, _ALIASES[name], late)
            for name, value in values.items()
        ]
        return Message(self._topic("NDATA"), encode(metrics, _now_ms(), self._seq), 0)

    def _bd(self) -> Metric:
        return Metric("bdSeq", _T.INT64, self._bd_seq, _now_ms())

    def _topic(self, verb: str) -> str:
        return f"{_NAMESPACE}/{self._group}/{verb}/{self._node}"


def _now_ms() -> int:
    return round(1000 * time.time())


def _values_of_status(status: Status) -> dict[str, Value]:
    fault = None if status.fault is None else vars(status.fault)
    return {
        "Cell/State": status.state.value,
        "Cell/Since": round(1000 * status.since_s),
        "Cell/Mode": status.mode.value,
        "Cell/Step": status.step,
        "Cell/Cycle": status.cycle,
        "Cell/Part": status.part,
        "Cell/Product": status.product,
        "Cell/Waiting for": ", ".join(status.waiting_for),
        "Cell/Model": status.model,
        "Cell/Software": status.software,
        **{f"Counts/{o.value}": status.counts.get(o.value, 0) for o in Outcome},
        **{f"Seconds/{s.value}": status.state_seconds.get(s.value, 0.0) for s in CellState},
        **_values_of_fault(fault),
        **({} if status.last is None else _values_of_result(status.last)),
    }


def _values_of_fault(fault: Mapping[str, Any] | None) -> dict[str, Value]:
    entries = fault or {}
    time_s = entries.get("time_s")
    return {
        "Fault/cycle": entries.get("cycle"),
        "Fault/time": None if time_s is None else round(1000 * time_s),
        **{f"Fault/{name}": entries.get(name) for name in _FAULT_TEXTS},
    }


def _values_of_result(result: Mapping[str, Any]) -> dict[str, Value]:
    text = json.dumps(plain(result), ensure_ascii=False)
    names = ("cycle", "outcome", "part", "reason", *_RESULT_NUMBERS)
    return {**{f"Result/{name}": result.get(name) for name in names}, "Result/JSON": text}


def _values_of_product(data: Mapping[str, Any]) -> dict[str, Value]:
    return {"Cell/Model": data["model"]} if "model" in data else {}


def _values_of(notice: Notice) -> dict[str, Value]:
    values: dict[str, Value]
    data = notice.data
    match notice.kind:
        case MessageKind.STATE:
            return {
                "Cell/State": data["state"],
                "Cell/Since": round(1000 * data["since"]),
                "Cell/Step": None,
            }
        case MessageKind.STEP:
            return {"Cell/Step": data["step"], "Cell/Cycle": data["cycle"]}
        case MessageKind.CYCLE:
            names = ("cycle", "part", "product")
            values = {f"Cell/{name.capitalize()}": data[name] for name in names}
            return values | _values_of_product(data)
        case MessageKind.RESULT:
            return _values_of_result(data)
        case MessageKind.FAULT:
            return _values_of_fault(data)
        case MessageKind.ACKNOWLEDGED:
            values = {f"Acknowledged/{name}": data[name] for name in ("by", "note")}
            return values | _values_of_fault(None)
        case MessageKind.PRODUCT:
            return {"Cell/Product": data["product"], **_values_of_product(data)}
        case MessageKind.WAITING:
            return {"Cell/Waiting for": ", ".join(data["waiting_for"])}
        case MessageKind.ADAPTER:
            return {}

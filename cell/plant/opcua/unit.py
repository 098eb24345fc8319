"""The unit: an object of PackML whose variables show a view of the cell."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from asyncua import ua

from cell.plant.opcua import packml
from cell.plant.opcua.packml import MACHINE_PATHS, MACHINES
from cell.plant.opcua.space import AddressSpace, Ids, NodeKind
from cell.plant.opcua.tags import (
    CELL_TAGS,
    NO_CELL,
    Missing,
    Tag,
    admin_tags,
    machine_tags,
    packml_tag,
    status_tags,
)
from cell.plant.opcua.types import reference_of, structure_class
from cell.plant.opcua.view import PackmlView

#: Objects of a unit below it: path, and number of the type in PackML; None = a plain object.
PARTS: tuple[tuple[str, int | None], ...] = (
    ("Admin", packml.ADMIN_TYPE),
    ("Status", packml.STATUS_TYPE),
    *((path, machine.type_id) for path, machine in zip(MACHINE_PATHS, MACHINES, strict=True)),
    ("Cell", None),
    ("Cell.Fault", None),
    ("Cell.LastResult", None),
    ("Cell.Counts", None),
    ("Cell.Seconds", None),
)


def tags_of(line: str, design_per_minute: float | None) -> tuple[Tag, ...]:
    """All variables of a unit.

    line               that the cell belongs to
    design_per_minute  cables that the cell makes at best; None = not set
    """
    return (
        packml_tag("TagID", "the line", lambda v, t: line, True),
        packml_tag("PackMLVersion", "of the types", lambda v, t: packml.VERSION, True),
        *(tag for level in range(len(MACHINES)) for tag in machine_tags(level)),
        *status_tags(design_per_minute),
        *admin_tags(design_per_minute),
        *CELL_TAGS,
    )


class Unit:
    """Object of a cell in a server's address space.

    name  browse name, and beginning of the ids of all nodes below it
    """

    def __init__(self, space: AddressSpace, name: str, tags: Sequence[Tag]) -> None:
        self._space, self._name, self._tags = space, name, tags
        self._shown: dict[str, Any] = {}
        self.node = self.id_of("")
        folder, type_ = packml.OBJECTS_FOLDER, space.node_id(packml.BASE_TYPE)
        space.object(
            space.node_id(folder), self.node, space.name(name, space.own), type_, Ids.Organizes
        )
        for path, number in PARTS:
            kind = Ids.BaseObjectType if number is None else space.node_id(number)
            space.object(self._parent(path), self.id_of(path), self.name_of(path), kind)
        for tag in tags:
            self._add(tag)

    def id_of(self, path: str) -> ua.NodeId:
        """Id of the node at a path within the unit; empty = the unit's own."""
        return self._space.own_id(f"{self._name}.{path}" if path else self._name)

    def name_of(self, path: str) -> ua.QualifiedName:
        """Browse name of the last part of a path, in the namespace that it belongs to."""
        first, last = path.split(".")[0], path.split(".")[-1]
        if first == "Cell":
            return self._space.name(last, self._space.own)
        below = first == "BaseStateMachine" and last not in ("BaseStateMachine",)
        of_type = below and last not in ("MachineState", "ExecuteState")
        return self._space.name(last, 0 if of_type else self._space.packml)

    def _parent(self, path: str) -> ua.NodeId:
        return self.id_of(path.rpartition(".")[0])

    def _add(self, tag: Tag) -> None:
        space, kind = self._space, self._space.kind(tag.type)
        node = space.variable(
            self._parent(tag.path),
            self.id_of(tag.path),
            self.name_of(tag.path),
            kind,
            type_=getattr(Ids, tag.definition),
            reference=reference_of(space, tag.reference),
            described=tag.meaning,
        )
        if tag.definition == "AnalogItemType":
            id_ = self.id_of(f"{tag.path}.EURange")
            space.standard_property(node, id_, "EURange", "Range", ua.Range(0.0, 60.0))

    async def show(self, view: PackmlView, at_s: float, now_s: float) -> None:
        """Write the values that have changed since the last call.

        at_s   time of the source, Unix time
        now_s  the same moment on the computer's own clock
        """
        at = datetime.fromtimestamp(at_s, UTC)
        for tag in self._tags:
            value = tag.value(view, now_s)
            if not tag.always and view.status is None:
                value = NO_CELL
            stale = not (tag.always or view.connected or isinstance(value, Missing))
            new = (value, stale)
            if tag.path in self._shown and self._shown[tag.path] == new:
                continue
            self._shown[tag.path] = new
            kind = self._space.kind(tag.type)
            await self._space.write(self.id_of(tag.path), self._data(value, stale, kind, at))

    def _data(self, value: Any, stale: bool, kind: NodeKind, at: datetime) -> ua.DataValue:
        if isinstance(value, Missing):
            quality = ua.StatusCode(getattr(ua.StatusCodes, value.quality))
            return ua.DataValue(StatusCode=quality, SourceTimestamp=at)
        code = ua.StatusCodes.UncertainLastUsableValue if stale else ua.StatusCodes.Good
        if kind.dimensions:
            array = self._array(value, kind)
        else:
            array = ua.Variant(self._plain(value, kind), kind.variant)
        return ua.DataValue(array, StatusCode=ua.StatusCode(code), SourceTimestamp=at)

    def _array(self, value: Sequence[Any], kind: NodeKind) -> ua.Variant:
        if kind.dimensions == 1:
            plain = [self._plain(item, kind) for item in value]
            return ua.Variant(plain, kind.variant, is_array=True)
        return ua.Variant([list(row) for row in value], kind.variant)

    def _plain(self, value: Any, kind: NodeKind) -> Any:
        """A value as OPC UA has it: nodes of PackML by their number, structures as tuples."""
        if kind.variant is ua.VariantType.NodeId:
            return self._space.node_id(value)
        if kind.variant is ua.VariantType.LocalizedText:
            return ua.LocalizedText(value)
        if kind.variant is not ua.VariantType.ExtensionObject:
            return value
        [structure] = [s for s in packml.STRUCTURES if self._space.node_id(s.id) == kind.node]
        names = [name for name, _ in structure.fields]
        fields = {n: v for n, v in zip(names, value, strict=True) if v is not None}
        return structure_class(structure.name)(**fields)

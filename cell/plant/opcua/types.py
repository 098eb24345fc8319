"""Builds the types of PackML in a server from the tables of the specification."""

from __future__ import annotations

from dataclasses import field, make_dataclass
from datetime import UTC, datetime
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AttributeValue

from cell.plant.opcua import packml
from cell.plant.opcua.packml import MACHINES, Declared, Method, StateMachine
from cell.plant.opcua.space import AddressSpace, Ids


def add_types(space: AddressSpace) -> None:
    """Add all types of PackML, and the folder of its units."""
    _references(space)
    _modes(space)
    for structure in packml.STRUCTURES:
        _structure(space, structure)
    for machine in reversed(MACHINES):
        _machine(space, machine)
    for name, number, variables in (
        ("PackMLStatusObjectType", packml.STATUS_TYPE, packml.STATUS),
        ("PackMLAdminObjectType", packml.ADMIN_TYPE, packml.ADMIN),
    ):
        type_ = _object_type(space, number, name)
        for variable in variables:
            _declare(space, type_, variable)
    _unit(space)
    space.object(
        ua.NodeId(Ids.ObjectsFolder),
        space.node_id(packml.OBJECTS_FOLDER),
        space.name("PackMLObjects"),
        Ids.FolderType,
        Ids.Organizes,
    )
    _namespace(space)


def structure_class(name: str) -> Any:
    """Class of the values of a structured type, which has been added to a server before."""
    return getattr(ua, name)


def _references(space: AddressSpace) -> None:
    for name, number in packml.REFERENCES.items():
        node, parent = space.node_id(number), ua.NodeId(Ids.HasComponent)
        space.type(parent, node, space.name(name), ua.NodeClass.ReferenceType)


def _modes(space: AddressSpace) -> None:
    node = space.node_id(packml.MODE_ENUM)
    name = space.name("ProductionMaintenanceModeEnum")
    space.type(ua.NodeId(Ids.Enumeration), node, name, ua.NodeClass.DataType)
    values = [
        ua.EnumValueType(number, ua.LocalizedText(text), ua.LocalizedText(text))
        for number, text in enumerate(packml.MODE_NAMES)
    ]
    space.standard_property(node, space.node_id(194), "EnumValues", "EnumValueType[]", values)
    fields = [
        ua.EnumField(number, ua.LocalizedText(text), ua.LocalizedText(text), text)
        for number, text in enumerate(packml.MODE_NAMES)
    ]
    _define(space, node, ua.EnumDefinition(fields))


def _structure(space: AddressSpace, structure: packml.Structure) -> None:
    node, encoding = space.node_id(structure.id), space.node_id(structure.encoding)
    name = space.name(structure.name)
    space.type(ua.NodeId(Ids.Structure), node, name, ua.NodeClass.DataType)
    binary = space.name("Default Binary", 0)
    space.object(node, encoding, binary, Ids.DataTypeEncodingType, Ids.HasEncoding)
    definition = ua.StructureDefinition(
        DefaultEncodingId=encoding,
        BaseDataType=ua.NodeId(Ids.Structure),
        StructureType=ua.StructureType.Structure,
    )
    for title, type_ in structure.fields:
        kind = space.kind(type_)
        rank = kind.dimensions or ua.ValueRank.Scalar
        made_field = ua.StructureField(Name=title, DataType=kind.node, ValueRank=rank)
        made_field.IsOptional = False  # else clients read every field as missing
        definition.Fields.append(made_field)
    _define(space, node, definition)
    members = [_member(title, type_) for title, type_ in structure.fields]
    made = make_dataclass(structure.name, members, namespace={"data_type": node})
    ua.register_extension_object(structure.name, encoding, made, node)


_TYPES: dict[str, tuple[Any, Any]] = {
    "Int32": (ua.Int32, 0),
    "String": (ua.String, ""),
    "Float": (ua.Float, 0.0),
    "Boolean": (ua.Boolean, False),
    "UtcTime": (ua.DateTime, datetime(1601, 1, 1, tzinfo=UTC)),
}


def _member(name: str, type_: str) -> tuple[str, Any, Any]:
    """A field of the class of a structure."""
    if type_.endswith("[]"):
        return name, list[structure_class(type_[:-2])], field(default_factory=list)  # type: ignore[misc]
    if type_ in _TYPES:
        kind, default = _TYPES[type_]
        return name, kind, field(default=default)
    kind = getattr(ua, type_)
    return name, kind, field(default_factory=kind)


def _define(space: AddressSpace, node: ua.NodeId, definition: Any) -> None:
    variant = ua.Variant(definition, ua.VariantType.ExtensionObject)
    data = space.server.iserver.aspace[node]
    data.attributes[ua.AttributeIds.DataTypeDefinition] = AttributeValue(ua.DataValue(variant))


def _object_type(
    space: AddressSpace, number: int, name: str, parent: int = Ids.BaseObjectType
) -> ua.NodeId:
    node = space.node_id(number)
    return space.type(ua.NodeId(parent), node, space.name(name), ua.NodeClass.ObjectType)


def reference_of(space: AddressSpace, name: str) -> int | ua.NodeId:
    """A type of references, by its name."""
    number = packml.REFERENCES.get(name)
    return getattr(Ids, name) if number is None else space.node_id(number)


def _declare(space: AddressSpace, parent: ua.NodeId, declared: Declared) -> None:
    node, analog = space.node_id(declared.id), declared.range_id is not None
    space.variable(
        parent,
        node,
        space.name(declared.name),
        space.kind(declared.type),
        type_=Ids.AnalogItemType if analog else Ids.BaseDataVariableType,
        reference=reference_of(space, declared.reference),
    )
    space.rule(node, declared.mandatory)
    if declared.range_id is not None:
        range_ = space.node_id(declared.range_id)
        space.rule(space.standard_property(node, range_, "EURange", "Range", ua.Range()), True)


def _method(space: AddressSpace, parent: ua.NodeId, method: Method) -> ua.NodeId:
    node = space.method(parent, space.node_id(method.id), space.name(method.name))
    space.rule(node, method.mandatory)
    if method.arguments_id is not None:
        listed = space.arguments(node, space.node_id(method.arguments_id), method.arguments)
        space.rule(listed, True)
    return node


def _machine(space: AddressSpace, machine: StateMachine) -> None:
    type_ = _object_type(space, machine.type_id, machine.name, Ids.FiniteStateMachineType)
    for name, number in (
        ("AvailableStates", machine.states_id),
        ("AvailableTransitions", machine.transitions_id),
    ):
        kind = space.kind("NodeId[]")
        node = space.variable(type_, space.node_id(number), space.name(name, 0), kind)
        space.rule(node, True)
    states = {}
    for state in machine.states:
        node = space.object(type_, space.node_id(state.id), space.name(state.name), Ids.StateType)
        states[state.name] = node
        _number(space, node, "StateNumber", state.number_id, state.number)
    methods = {method.name: _method(space, type_, method) for method in machine.methods}
    for transition in machine.transitions:
        name, node = space.name(transition.name), space.node_id(transition.id)
        space.object(type_, node, name, Ids.TransitionType)
        _number(space, node, "TransitionNumber", transition.number_id, transition.id)
        space.refer(node, Ids.FromState, states[transition.source])
        space.refer(node, Ids.ToState, states[transition.target])
        if transition.cause is not None:
            space.refer(node, Ids.HasCause, methods[transition.cause])
    if machine.part is not None and machine.parent is not None:
        name, number = machine.part
        inner = MACHINES[MACHINES.index(machine) + 1].type_id
        node = space.node_id(number)
        space.object(type_, node, space.name(name), space.node_id(inner))
        space.rule(node, True)
        space.refer(states[machine.parent], Ids.HasSubStateMachine, node)


def _number(space: AddressSpace, node: ua.NodeId, name: str, id_: int, number: int) -> None:
    added = space.standard_property(node, space.node_id(id_), name, "UInt32", number)
    space.rule(added, True)


def _unit(space: AddressSpace) -> None:
    type_ = _object_type(space, packml.BASE_TYPE, "PackMLBaseObjectType")
    for declared in packml.UNIT:
        _declare(space, type_, declared)
    for name, number, part in packml.UNIT_PARTS:
        node = space.node_id(number)
        space.object(type_, node, space.name(name), space.node_id(part))
        space.rule(node, True)
    for method in packml.UNIT_METHODS:
        _method(space, type_, method)


def _namespace(space: AddressSpace) -> None:
    """Metadata of the namespace of PackML."""
    node = space.node_id(117)
    name = space.name(packml.URI)
    space.object(ua.NodeId(Ids.Server_Namespaces), node, name, Ids.NamespaceMetadataType)
    published = datetime.fromisoformat(packml.PUBLISHED).replace(tzinfo=UTC)
    for title, number, type_, value in (
        ("NamespaceUri", 356, "String", packml.URI),
        ("NamespaceVersion", 357, "String", packml.VERSION),
        ("NamespacePublicationDate", 355, "DateTime", published),
        ("IsNamespaceSubset", 354, "Boolean", True),
    ):
        space.standard_property(node, space.node_id(number), title, type_, value)

"""Adds nodes to the address space of a server, one call each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from asyncua import Server, ua

from cell.plant.opcua import packml

Ids = ua.ObjectIds


@dataclass(frozen=True)
class NodeKind:
    """A data type: its node, the type of a variant of it, and its dimensions (0 = one value)."""

    node: ua.NodeId
    variant: ua.VariantType
    dimensions: int = 0


class AddressSpace:
    """Address space of one server.

    packml, own  indexes of the namespaces of PackML and of this program
    """

    def __init__(self, server: Server, packml_index: int, own_index: int) -> None:
        self.server = server
        self.packml = packml_index
        self.own = own_index

    def node_id(self, number: int) -> ua.NodeId:
        """Id of a node of PackML."""
        return ua.NodeId(number, self.packml)

    def own_id(self, path: str) -> ua.NodeId:
        """Id of a node of this program."""
        return ua.NodeId(path, self.own)

    def name(self, name: str, namespace: int | None = None) -> ua.QualifiedName:
        """A browse name; of PackML by default."""
        return ua.QualifiedName(name, self.packml if namespace is None else namespace)

    def kind(self, name: str) -> NodeKind:
        """A data type by its name in the tables.  Raises KeyError: there is none."""
        plain = name.replace("[]", "")
        dimensions = (len(name) - len(plain)) // 2
        if plain == "Mode":
            return NodeKind(self.node_id(packml.MODE_ENUM), ua.VariantType.Int32, dimensions)
        for structure in packml.STRUCTURES:
            if structure.name == plain:
                return NodeKind(
                    self.node_id(structure.id), ua.VariantType.ExtensionObject, dimensions
                )
        if plain == "UtcTime":
            return NodeKind(ua.NodeId(Ids.UtcTime), ua.VariantType.DateTime, dimensions)
        if plain in ("EUInformation", "Range", "Argument", "EnumValueType"):
            node = ua.NodeId(getattr(Ids, plain))
            return NodeKind(node, ua.VariantType.ExtensionObject, dimensions)
        return NodeKind(ua.NodeId(getattr(Ids, plain)), ua.VariantType[plain], dimensions)

    def object(
        self,
        parent: ua.NodeId,
        node: ua.NodeId,
        name: ua.QualifiedName,
        type_: int | ua.NodeId,
        reference: int | ua.NodeId = Ids.HasComponent,
    ) -> ua.NodeId:
        """Add an object; returns its id."""
        item = _item(ua.NodeClass.Object, parent, node, name, reference)
        item.TypeDefinition = ua.NodeId(type_) if isinstance(type_, int) else type_
        return self._add(item, ua.ObjectAttributes(EventNotifier=0))

    def variable(
        self,
        parent: ua.NodeId,
        node: ua.NodeId,
        name: ua.QualifiedName,
        kind: NodeKind,
        value: Any = None,
        *,
        type_: int = Ids.BaseDataVariableType,
        reference: int | ua.NodeId = Ids.HasComponent,
        described: str = "",
    ) -> ua.NodeId:
        """Add a variable that clients may read; returns its id."""
        item = _item(ua.NodeClass.Variable, parent, node, name, reference)
        property_ = reference == Ids.HasProperty
        item.TypeDefinition = ua.NodeId(Ids.PropertyType if property_ else type_)
        variant = ua.VariantType.Null if value is None else kind.variant
        attributes = ua.VariableAttributes(
            Value=ua.Variant(value, variant),
            DataType=kind.node,
            ValueRank=kind.dimensions or ua.ValueRank.Scalar,
            ArrayDimensions=[0] * kind.dimensions or None,
            AccessLevel=ua.AccessLevel.CurrentRead.mask,
            UserAccessLevel=ua.AccessLevel.CurrentRead.mask,
            Historizing=False,
        )
        return self._add(item, attributes, described)

    def standard_property(
        self, parent: ua.NodeId, node: ua.NodeId, name: str, type_: str, value: Any
    ) -> ua.NodeId:
        """Add a property that OPC UA itself names; returns its id."""
        qualified, kind = self.name(name, 0), self.kind(type_)
        return self.variable(parent, node, qualified, kind, value, reference=Ids.HasProperty)

    def method(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, described: str = ""
    ) -> ua.NodeId:
        """Add a method without arguments; returns its id."""
        item = _item(ua.NodeClass.Method, parent, node, name, Ids.HasComponent)
        attributes = ua.MethodAttributes(Executable=True, UserExecutable=True)
        return self._add(item, attributes, described)

    def arguments(
        self, method: ua.NodeId, node: ua.NodeId, arguments: Sequence[tuple[str, str]]
    ) -> ua.NodeId:
        """Add the list of a method's arguments, (name, data type) each; returns its id."""
        value = []
        for name, type_ in arguments:
            kind = self.kind(type_)
            rank = kind.dimensions or ua.ValueRank.Scalar
            sizes = [0] * kind.dimensions
            value.append(ua.Argument(name, kind.node, rank, sizes, ua.LocalizedText(name)))
        return self.standard_property(method, node, "InputArguments", "Argument[]", value)

    def type(
        self, parent: ua.NodeId, node: ua.NodeId, name: ua.QualifiedName, class_: ua.NodeClass
    ) -> ua.NodeId:
        """Add a type of objects, of data or of references; returns its id."""
        item = _item(class_, parent, node, name, Ids.HasSubtype)
        attributes = {
            ua.NodeClass.ObjectType: ua.ObjectTypeAttributes,
            ua.NodeClass.DataType: ua.DataTypeAttributes,
            ua.NodeClass.ReferenceType: ua.ReferenceTypeAttributes,
        }[class_]
        return self._add(item, attributes(IsAbstract=False))

    async def write(self, node: ua.NodeId, data: ua.DataValue) -> None:
        """Give a variable a value; its subscribers are notified."""
        status = await self.server.iserver.aspace.write_attribute_value(
            node, ua.AttributeIds.Value, data
        )
        status.check()

    def refer(self, source: ua.NodeId, reference: int, target: ua.NodeId) -> None:
        """Add a reference, and the one back."""
        aspace = self.server.iserver.aspace
        for start, end, forward in ((source, target, True), (target, source, False)):
            node_class = aspace[end].attributes[ua.AttributeIds.NodeClass].value
            assert node_class is not None
            assert node_class.Value is not None
            item = ua.AddReferencesItem(
                SourceNodeId=start,
                ReferenceTypeId=ua.NodeId(reference),
                IsForward=forward,
                TargetNodeId=end,
                TargetNodeClass=node_class.Value.Value,
            )
            [status] = self.server.iserver.node_mgt_service.add_references([item])
            status.check()

    def rule(self, node: ua.NodeId, mandatory: bool) -> None:
        """Say whether every instance of a type has this node."""
        rule = Ids.ModellingRule_Mandatory if mandatory else Ids.ModellingRule_Optional
        self.refer(node, Ids.HasModellingRule, ua.NodeId(rule))

    def _add(self, item: ua.AddNodesItem, attributes: Any, described: str = "") -> ua.NodeId:
        attributes.DisplayName = ua.LocalizedText(item.BrowseName.Name)
        attributes.Description = ua.LocalizedText(described or item.BrowseName.Name)
        attributes.WriteMask = attributes.UserWriteMask = 0
        item.NodeAttributes = attributes
        [added] = self.server.iserver.node_mgt_service.add_nodes([item])
        added.StatusCode.check()
        return added.AddedNodeId


def _item(
    class_: ua.NodeClass,
    parent: ua.NodeId,
    node: ua.NodeId,
    name: ua.QualifiedName,
    reference: int | ua.NodeId,
) -> ua.AddNodesItem:
    reference = ua.NodeId(reference) if isinstance(reference, int) else reference
    return ua.AddNodesItem(
        ParentNodeId=parent,
        ReferenceTypeId=reference,
        RequestedNewNodeId=node,
        BrowseName=name,
        NodeClass=class_,
    )

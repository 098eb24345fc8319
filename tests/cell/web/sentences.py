"""Sentences that the program says to operators, as its source shows them.

A sentence is found where it is given to the constructor of a known error or fault.  What a
placeholder stands for is followed to constants of the function, the module and the class; the
rest is a `Hole`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import product
from pathlib import Path

ROOT = Path(__file__).parents[3]
#: Places whose sentences the operators' pages show.
PLACES = (
    *("drivers", "calib", "cell/run", "cell/plan", "cell/vision", "cell/identify"),
    *(
        "cell/plant/client.py",
        "cell/plant/service.py",
        "cell/plant/children.py",
    ),
    *("cell/calibration", "cell/wiring/filmed.py"),
    *("cell/records/folder.py", "cell/records/recording/film.py", "cell/records/chart.py"),
    *("cell/records/ledger/database.py", "cell/records/recording/writer.py"),
    *("cell/settings/calibrated.py", "cell/cable/statics.py"),
)
#: Programs that pretend to be devices, and what a person only sees at a terminal.
LEFT_OUT = ("drivers/emulators", "cell/calibration/raw.py", "cell/calibration/report.py")

_ONE, _TWO = {0: "cause"}, {0: "cause", 1: "remedy"}
_OF_DEVICE = {1: "cause", 2: "remedy"}
#: Constructor or function → its arguments that are sentences, by place, with their names.
CALLS: Mapping[str, Mapping[int, str]] = {
    **dict.fromkeys(("DeviceError", "ConnectError", "DeviceLostError", "LimitError"), _OF_DEVICE),
    **dict.fromkeys(("DeviceTimeoutError", "TooLateError", "StoppedError"), _OF_DEVICE),
    **dict.fromkeys(("GripError", "CameraError", "OtherMotionError"), _OF_DEVICE),
    **dict.fromkeys(("RefusedError", "Refusal", "CalibrationError", "TooFewError"), _TWO),
    **dict.fromkeys(("OneSidedError", "BlurredError", "MisfitError", "WrongBoardError"), _TWO),
    "WrongScaleError": _TWO,
    "UnsettledError": {1: "cause"},
    **dict.fromkeys(("_LostError", "OutOfReachError", "FitError", "StripNotFoundError"), _ONE),
    **dict.fromkeys(("StoreError", "RecordError", "LinkError", "NoCellError"), _ONE),
    **dict.fromkeys(
        (
            "ProtocolError",
            "LedgerError",
            "FullDiskError",
            "reject",
            "leave",
            "say",
            "_say",
            "_asked",
        ),
        _ONE,
    ),
    "Fault": {1: "cause", 3: "remedy", 4: "cable"},
    "FaultNotice": {2: "cause", 5: "remedy", 6: "cable"},
    "CableRejectedError": {1: "detail"},
    "Passage": {3: "reason"},
    "Choice": {2: "reason"},
    "Drift": {1: "sentence"},
    "VersionRange": {3: "says"},
    "Check": {5: "remedy"},
}
#: Functions that return sentences, and tables of them.
RETURNED = {
    "cell/run/endings.py": ("whereabouts_of_cable",),
    "cell/records/recording/film.py": ("why_no_film",),
    "cell/settings/calibrated.py": ("complaint_of",),
    "cell/calibration/work.py": ("_words", "_too_poor"),
    "cell/records/chart.py": ("__str__",),
    "drivers/ur_process.py": ("farewell",),
}
TABLES = {"drivers/interfaces.py": ("_REMEDIES",), "drivers/robotiq_gripper.py": ("_FAULTS",)}
#: A sentence with more ways to be said than this is cut short.
_MOST = 40


@dataclass(frozen=True)
class Hole:
    """Place of a value in a sentence; `number`: it has a format that only numbers have."""

    number: bool
    percent: bool = False


Parts = tuple["str | Hole", ...]


@dataclass(frozen=True)
class Sentence:
    """A sentence with holes, and where the source says it: `path:line`."""

    parts: Parts
    where: str

    @property
    def shape(self) -> str:
        """The sentence for people, with … for values."""
        return "".join(p if isinstance(p, str) else "{…}" for p in self.parts)


def said_by_the_source() -> Iterator[Sentence]:
    """All sentences of the source, in the order of its files."""
    for file, name in _files():
        yield from of_source(_source(file), name)


def errors_of_the_source() -> Iterator[tuple[str, str]]:
    """Classes of errors made from those of `CALLS`, and where."""
    for file, name in _files():
        for node in ast.walk(_source(file).tree):
            bases = node.bases if isinstance(node, ast.ClassDef) else ()
            if any(isinstance(b, ast.Name) and b.id in CALLS for b in bases):
                yield node.name, f"{name}:{node.lineno}"


def _files() -> Iterator[tuple[Path, str]]:
    for place in PLACES:
        path = ROOT / place
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            name = file.relative_to(ROOT).as_posix()
            if not name.startswith(LEFT_OUT):
                yield file, name


def of_text(text: str) -> Iterator[Sentence]:
    """Sentences of a source that is no file."""
    return of_source(Source(ast.parse(text)), "text")


def of_source(source: Source, name: str) -> Iterator[Sentence]:
    """Sentences of one file."""
    for function in RETURNED.get(name, ()):
        yield from _worded(source._returned(function, 0), f"{name}: {function}")
    for table in TABLES.get(name, ()):
        yield from _worded(source._named(table, (), 0), f"{name}: {table}")
    for call, scope in source.calls:
        wanted = CALLS.get(_called(call), {}) if _said(call, name) else {}
        given: list[ast.expr] = [call.args[i] for i in wanted if i < len(call.args)]
        given += [k.value for k in call.keywords if k.arg in wanted.values()]
        for expression in given:
            yield from _worded(source.ways(expression, scope), f"{name}:{expression.lineno}")


def _worded(ways: list[Parts], where: str) -> Iterator[Sentence]:
    for parts in ways:
        if any(isinstance(p, str) and any(c.isalpha() for c in p) for p in parts):
            yield Sentence(parts, where)


def _said(call: ast.Call, name: str) -> bool:
    """Whether a call says something to a person: a `say` of the plant says it to a program."""
    return "say" not in _called(call) or name.startswith("cell/calibration")


def _called(call: ast.Call) -> str:
    if isinstance(call.func, ast.Attribute):
        return call.func.attr
    return call.func.id if isinstance(call.func, ast.Name) else ""


@cache
def _source(file: Path) -> Source:
    return Source(ast.parse(file.read_text("utf-8")))


Scope = tuple[ast.AST, ...]


@dataclass(eq=False)
class Source:
    """A module's tree, and what its names stand for."""

    tree: ast.Module
    calls: list[tuple[ast.Call, Scope]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._visit(self.tree, ())

    def _visit(self, node: ast.AST, scope: Scope) -> None:
        if isinstance(node, ast.Call):
            self.calls.append((node, scope))
        if isinstance(node, (ast.Module, ast.FunctionDef, ast.ClassDef)):
            scope = (node, *scope)
        for child in ast.iter_child_nodes(node):
            self._visit(child, scope)

    @cached_property
    def _imported(self) -> dict[str, tuple[Path, str]]:
        found = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                file = ROOT / (node.module.replace(".", "/") + ".py")
                if file.is_file():
                    found |= {(a.asname or a.name): (file, a.name) for a in node.names}
        return found

    def ways(self, node: ast.expr, scope: Scope, depth: int = 0) -> list[Parts]:
        """Ways in which an expression is said."""
        if depth > 6:
            return [(Hole(False),)]
        match node:
            case ast.Constant(value=None):
                return []
            case ast.Constant(value=str(text)):
                return [(text,)]
            case ast.JoinedStr(values=values):
                return self._joined([self.ways(v, scope, depth) for v in values])
            case ast.FormattedValue(value=value, format_spec=None, conversion=-1):
                return self.ways(value, scope, depth + 1) or [(Hole(False),)]
            case ast.FormattedValue(format_spec=ast.JoinedStr(values=[ast.Constant(value=spec)])):
                return [(Hole(spec[-1] in "defg%", spec[-1] == "%"),)]
            case ast.IfExp(body=one, orelse=other):
                return [*self.ways(one, scope, depth), *self.ways(other, scope, depth)]
            case ast.BoolOp(op=ast.Or(), values=values):
                return [way for v in values for way in self.ways(v, scope, depth)]
            case ast.BinOp(left=left, op=ast.Add(), right=right) if not _number(right):
                return self._joined([self.ways(left, scope, depth), self.ways(right, scope, depth)])
            case ast.Dict(values=values) | ast.Tuple(elts=values):
                return [way for v in values for way in self.ways(v, scope, depth)]
            case ast.Subscript(value=ast.Name() as value):
                return self.ways(value, scope, depth + 1)
            case ast.Name(id=name):
                return self._named(name, scope, depth + 1) or [(Hole(False),)]
            case ast.Attribute(value=ast.Name(id="self"), attr=name):
                return self._of_self(name, depth + 1) or [(Hole(False),)]
            case ast.Call(func=ast.Attribute(value=value, attr="strip" | "rstrip")):
                return self.ways(value, scope, depth)
            case ast.Call(func=ast.Name(id=name)):
                return self._returned(name, depth + 1) or [(Hole(False),)]
            case ast.Call(func=ast.Attribute(value=ast.Name(id="self"), attr=name)):
                return self._returned(name, depth + 1) or [(Hole(False),)]
        return [(Hole(False),)]

    def _joined(self, each: list[list[Parts]]) -> list[Parts]:
        ways = (tuple(p for part in way for p in part) for way in product(*each))
        return [way for way, _ in zip(ways, range(_MOST), strict=False)]

    def _assigned(self, tree: ast.AST, name: str) -> Iterator[ast.expr]:
        for node in ast.walk(tree):
            match node:
                case (
                    ast.Assign(targets=[ast.Name(id=found)], value=value)
                    | ast.AnnAssign(target=ast.Name(id=found), value=ast.expr() as value)
                    | ast.AugAssign(target=ast.Name(id=found), value=value)
                ) if found == name:
                    yield value
                case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                    for one, value in zip(names, values, strict=False):
                        if isinstance(one, ast.Name) and one.id == name:
                            yield value

    def _named(self, name: str, scope: Scope, depth: int) -> list[Parts]:
        for place in scope:
            if isinstance(place, ast.FunctionDef):
                found = [
                    way
                    for value in self._assigned(place, name)
                    for way in self.ways(value, scope, depth)
                ]
                arguments = [a.arg for a in (*place.args.args, *place.args.kwonlyargs)]
                if name in arguments:
                    found += self._passed(place, name, depth)
                if found:
                    return found
        values = [v for n in self.tree.body for v in self._assigned(n, name) if _top(n)]
        if values:
            return [way for v in values for way in self.ways(v, (self.tree,), depth)]
        if name in self._imported:
            file, wanted = self._imported[name]
            return _source(file)._named(wanted, (), depth)
        return []

    def _passed(self, function: ast.FunctionDef, name: str, depth: int) -> list[Parts]:
        """What callers in this module give for an argument of a function."""
        arguments = [a.arg for a in function.args.args]
        found: list[Parts] = []
        for call, scope in self.calls:
            own = _called(call)
            if own != function.name:
                continue
            shift = 1 if arguments[:1] == ["self"] and isinstance(call.func, ast.Attribute) else 0
            place = arguments.index(name) - shift if name in arguments else len(call.args)
            given = [call.args[place]] if 0 <= place < len(call.args) else []
            given += [k.value for k in call.keywords if k.arg == name]
            found += [way for value in given for way in self.ways(value, scope, depth)]
        return found

    def _of_self(self, name: str, depth: int) -> list[Parts]:
        found = []
        for node in ast.walk(self.tree):
            match node:
                case (
                    ast.Assign(
                        targets=[ast.Attribute(value=ast.Name(id="self"), attr=attr)], value=value
                    )
                    | ast.AnnAssign(
                        target=ast.Attribute(value=ast.Name(id="self"), attr=attr),
                        value=ast.expr() as value,
                    )
                ) if attr == name and not _empty(value):
                    found += self.ways(value, (self.tree,), depth)
        return found

    def _returned(self, name: str, depth: int) -> list[Parts]:
        if name in self._imported:
            file, wanted = self._imported[name]
            return _source(file)._returned(wanted, depth)
        for node in ast.walk(self.tree):
            if isinstance(node, ast.FunctionDef) and node.name == name:
                return [
                    way
                    for r in ast.walk(node)
                    if isinstance(r, ast.Return) and r.value is not None
                    for way in self.ways(r.value, (node, self.tree), depth)
                ]
        return []


def _number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def _top(node: ast.AST) -> bool:
    return isinstance(node, (ast.Assign, ast.AnnAssign))


def _empty(value: ast.expr) -> bool:
    return isinstance(value, ast.Constant) and not value.value

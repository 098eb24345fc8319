"""Whether a file that nobody has read can only be a law: its source is looked at, not run."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from cell.cable.effects.refused import EffectError

#: What of `cell.cable.effects` may be imported.
_OURS = ("Bend", "CableData", "Effect", "HandMotion", "Parameter", "Place")
#: Functions of numpy that are no ufuncs, and touch neither files nor memory.
_NUMPY = {
    *("abs", "all", "any", "arange", "array", "asarray", "clip", "cumsum", "diff", "dot", "empty"),
    *("interp", "linspace", "max", "maximum", "mean", "min", "minimum", "ones", "ones_like"),
    *("stack", "sum", "where", "zeros", "zeros_like", "float64", "int64", "ndarray"),
}
#: Names of Python that reach beyond a computation.
_BEYOND = {
    *("breakpoint", "compile", "delattr", "dir", "eval", "exec", "getattr", "globals", "help"),
    *("input", "locals", "memoryview", "object", "open", "setattr", "super", "type", "vars"),
}
#: Methods of arrays that reach files and memory.
_OF_ARRAYS = {"ctypes", "data", "dump", "dumps", "setflags", "tofile"}
_REMEDY = "read the file, and give it as --effect if you trust it"
#: Attributes by which code is reached from an object begin so.
_INNER = ("__", "f_", "gi_", "cr_", "ag_", "tb_", "co_", "func_", "mro")


def check_untrusted(path: Path) -> None:
    """Refuse a file that could do more than compute.

    It may import `math`, parts of numpy and what an effect is made of.  This protects from files
    that a program wrote.

    raises  EffectError: with the line, what is not allowed, and what to do
    """
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        cause = f"is not Python: {error}; mend that"
        raise EffectError(path, getattr(error, "lineno", None) or 1, cause) from error
    modules: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules |= _imported(path, node)
    of_attributes = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    for node in ast.walk(tree):
        found = _beyond(node, modules)
        if isinstance(node, ast.Name) and node.id in modules and id(node) not in of_attributes:
            found = f"another name for `{node.id}`"  # whose attributes would not be looked at
        if found:
            cause = f"{found} is not allowed in a file of --candidates; {_REMEDY}"
            raise EffectError(path, getattr(node, "lineno", 1), cause)


def _imported(path: Path, node: ast.Import | ast.ImportFrom) -> dict[str, str]:
    """What modules are called here; others are refused."""
    module = node.module if isinstance(node, ast.ImportFrom) else None
    called: dict[str, str] = {}
    for alias in node.names:
        if isinstance(node, ast.Import):
            allowed = alias.name in ("math", "numpy")
            called[alias.asname or alias.name] = alias.name
        else:
            allowed = node.level == 0 and _may_import(module or "", alias.name)
        if not allowed:
            wanted = f"{module}.{alias.name}" if module else alias.name
            cause = (
                f"imports {wanted}: a file of --candidates may import math, functions of numpy and "
                f"{', '.join(_OURS)} of cell.cable.effects; {_REMEDY}"
            )
            raise EffectError(path, node.lineno, cause)
    return called


def _may_import(module: str, name: str) -> bool:
    if module == "numpy":
        return _is_plain_numpy(name)
    if module == "cell.cable.effects":
        return name in _OURS
    return module == "__future__" or (module == "math" and hasattr(math, name))


def _is_plain_numpy(name: str) -> bool:
    return isinstance(getattr(np, name, None), np.ufunc | float) or name in _NUMPY


def _beyond(node: ast.AST, modules: Mapping[str, str]) -> str:
    """What a node reaches beyond a computation; empty if it does not."""
    if isinstance(node, ast.Name) and node.id in _BEYOND:
        return f"`{node.id}`"
    if isinstance(node, ast.Attribute):
        if node.attr.startswith(_INNER) or node.attr in _OF_ARRAYS:
            return f"`.{node.attr}`"
        of = node.value.id if isinstance(node.value, ast.Name) else ""
        if modules.get(of) == "numpy" and not _is_plain_numpy(node.attr):
            return f"`{of}.{node.attr}`"
    if isinstance(node, ast.MatchClass):
        for attribute in node.kwd_attrs:
            if attribute.startswith(_INNER) or attribute in _OF_ARRAYS:
                return f"`.{attribute}`"
    for name in _identifiers(node):
        if name.startswith("__"):
            return f"`{name}`"
    if isinstance(node, ast.Global | ast.Nonlocal | ast.AsyncFunctionDef):
        return f"`{type(node).__name__.lower()}`"
    return ""


def _identifiers(node: ast.AST) -> Iterator[str]:
    """Names that a node reads or gives, wherever they stand in it.

    A name of Python's own is as good as an attribute: numpy asks an object with a method of such a
    name where its numbers are in memory.
    """
    if isinstance(node, ast.Constant):
        return
    for field, value in ast.iter_fields(node):
        if field != "module":  # of an import: it is looked at there
            values = value if isinstance(value, list) else [value]
            yield from (v for v in values if isinstance(v, str))

"""Static check of an untrusted effect file: its source may only compute; it is not run."""

from __future__ import annotations

import ast
import builtins
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import GeneratorType

import numpy as np

from cell.cable.effects.base import EffectError
from cell.files.words import error_text

#: What of `cell.cable.effects` may be imported.
_OURS = ("Bend", "CableData", "Effect", "HandMotion", "Parameter", "Place")
#: Functions of numpy that are no ufuncs, and touch neither files nor memory.
_NUMPY = {
    *("abs", "all", "any", "arange", "array", "asarray", "clip", "cumsum", "diff", "dot", "empty"),
    *("interp", "linspace", "max", "maximum", "mean", "min", "minimum", "ones", "ones_like"),
    *("stack", "sum", "where", "zeros", "zeros_like", "float64", "int64", "ndarray"),
}
#: Names of Python that only compute; its others are refused.
_BUILTINS = {
    *("abs", "all", "any", "bool", "complex", "dict", "divmod", "enumerate", "filter", "float"),
    *("int", "isinstance", "len", "list", "map", "max", "min", "pow", "range", "reversed"),
    *("round", "set", "sorted", "staticmethod", "sum", "tuple", "zip"),
    *("ArithmeticError", "ValueError", "ZeroDivisionError", "OverflowError"),
}
#: Names that `site` adds to them: `license` prints any file.
_SITE = {"copyright", "credits", "exit", "help", "license", "quit"}
#: Methods and fields of arrays and lists that only compute.
_OF_ARRAYS = {
    *("T", "all", "any", "append", "astype", "clip", "copy", "cumsum", "dot", "flatten", "imag"),
    *("max", "mean", "min", "ndim", "ravel", "real", "reshape", "shape", "size", "sum"),
    *("transpose",),
}
#: Types with methods that do more: print globals, read memory, write files.
_OBJECTS = (np.ndarray, str, bytes, list, dict, tuple, type, type(lambda: 0), GeneratorType)
#: Syntax that a law needs; all other is refused.
_SYNTAX = (
    *(ast.Module, ast.ClassDef, ast.FunctionDef, ast.Lambda, ast.Return, ast.arguments, ast.arg),
    *(ast.Assign, ast.AnnAssign, ast.AugAssign, ast.NamedExpr, ast.For, ast.While, ast.If),
    *(ast.Break, ast.Continue, ast.Pass, ast.Raise, ast.Assert, ast.Import, ast.ImportFrom),
    *(ast.alias, ast.Expr, ast.BoolOp, ast.BinOp, ast.UnaryOp, ast.IfExp, ast.Compare, ast.Call),
    *(ast.keyword, ast.Constant, ast.Attribute, ast.Subscript, ast.Slice, ast.Starred, ast.Name),
    *(ast.List, ast.Tuple, ast.Dict, ast.Set, ast.ListComp, ast.SetComp, ast.DictComp),
    *(ast.GeneratorExp, ast.comprehension, ast.expr_context, ast.boolop, ast.operator),
    *(ast.unaryop, ast.cmpop),
)
_REMEDY = "read the file, and give it as --try if you trust it"


def check_untrusted(path: Path) -> None:
    """Refuse a file that could do more than compute: help for a law's author, not a protection.

    It may import `math`, parts of numpy and what an effect is made of, use names of Python and
    methods of arrays that only compute; an imported name must have no second meaning.  Protection
    is by the sandbox in which the file runs.

    raises  EffectError: with the line, the forbidden construct, and the remedy
    """
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise EffectError(
            path, 1, f"cannot be read: {error.strerror}; mend or remove it"
        ) from error
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        cause = f"is not Python: {error_text(error)}; mend that"
        raise EffectError(path, getattr(error, "lineno", None) or 1, cause) from error
    modules: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules |= _imported(path, node)
    bound = Counter(name for node in ast.walk(tree) for name in _bound(node))
    of_attributes = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    for node in ast.walk(tree):
        forbidden = _beyond(node, modules)
        if isinstance(node, ast.Name) and node.id in modules and id(node) not in of_attributes:
            forbidden = f"another name for `{node.id}`"  # whose attributes would not be looked at
        if isinstance(node, ast.Import | ast.ImportFrom):
            twice = [n for n in _bound(node) if bound[n] > 1]
            forbidden = forbidden or (f"`{twice[0]}` with two meanings" if twice else "")
        if forbidden:
            cause = f"{forbidden} is not allowed in a file of --candidates; {_REMEDY}"
            raise EffectError(path, getattr(node, "lineno", 1), cause)


def _bound(node: ast.AST) -> list[str]:
    """Names that a node binds."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        return [a.asname or a.name for a in node.names]
    if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
        return [node.id]
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return [node.name]
    return [node.arg] if isinstance(node, ast.arg) else []


def _imported(path: Path, node: ast.Import | ast.ImportFrom) -> dict[str, str]:
    """Modules by their local names; raises EffectError for others."""
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
    """The forbidden construct in a node; empty if it only computes."""
    for name in _identifiers(node):
        if name.startswith("__"):
            return f"`{name}`"
    if isinstance(node, ast.Name) and node.id not in _BUILTINS and _is_of_python(node.id):
        return f"`{node.id}`"
    if isinstance(node, ast.Attribute):
        of = node.value.id if isinstance(node.value, ast.Name) else ""
        if of in modules:
            plain = modules[of] == "math" or _is_plain_numpy(node.attr)
            return "" if plain else f"`{of}.{node.attr}`"
        if node.attr.startswith("_"):
            return f"`.{node.attr}`"
        if node.attr not in _OF_ARRAYS and any(hasattr(o, node.attr) for o in _OBJECTS):
            return f"`.{node.attr}`"
    if not isinstance(node, _SYNTAX):
        return f"`{type(node).__name__.lower()}`"
    return ""


def _is_of_python(name: str) -> bool:
    return hasattr(builtins, name) or name in _SITE


def _identifiers(node: ast.AST) -> Iterator[str]:
    """All names in a node.

    A special name of Python is as dangerous as an attribute: numpy asks an object with a method of
    such a name for the address of its numbers.
    """
    if isinstance(node, ast.Constant):
        return
    for field, value in ast.iter_fields(node):
        if field != "module":  # of an import: checked in `_imported`
            values = value if isinstance(value, list) else [value]
            yield from (v for v in values if isinstance(v, str))

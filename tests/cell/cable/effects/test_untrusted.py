"""A file that nobody has read may compute, and nothing else."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.cable.effects import EffectError, library
from cell.cable.effects.untrusted import check_untrusted

LAW = '''
import math
import numpy as np
from numpy import pi, sin
from cell.cable.effects import Effect, Parameter


class Law(Effect):
    """F = a sin(t)."""

    name = "law"
    parameters = (Parameter("a_n", "N", 0.0, 1.0, default=0.0),)

    def force(cable, at, p):
        return 0.0 * math.sqrt(2.0), p.a_n * np.sin(pi * sin(at.x))
'''


def written(folder: Path, text: str) -> Path:
    path = folder / "law.py"
    path.write_text(text)
    return path


def test_a_law_is_allowed(tmp_path: Path) -> None:
    check_untrusted(written(tmp_path, LAW))


@pytest.mark.parametrize("effect", library().values())
def test_the_laws_of_the_library_would_be(effect: type, tmp_path: Path) -> None:
    """But for what they import of the project, which their class does not show."""
    check_untrusted(written(tmp_path, inspect.getsource(effect)))


@pytest.mark.parametrize(
    ("more", "line", "said"),
    [
        ("import os", 16, "imports os: a file of --candidates may import math"),
        ("from os import system", 16, "imports os.system"),
        ("from . import law", 16, "imports law"),
        ("import numpy.ctypeslib", 16, "imports numpy.ctypeslib"),
        ("from numpy import save", 16, "imports numpy.save"),
        ("from numpy import *", 16, r"imports numpy.\*"),
        (
            "from cell.cable.effects import load_effect",
            16,
            "imports cell.cable.effects.load_effect",
        ),
        ("import cell.cable.effects.library as l", 16, "imports cell.cable.effects.library"),
        ("\nopen('x', 'w')", 17, "`open` is not allowed"),
        ("a = np.fromfile('x')", 16, "`np.fromfile` is not allowed"),
        ("n = np\nn.save('x', 1)", 16, "another name for `np` is not allowed"),
        ("(lambda n: n.save('x', 1))(np)", 16, "another name for `np`"),
        ("x = [np][0]", 16, "another name for `np`"),
        ("x = ().__class__.__base__", 16, "`__(class|base)__` is not allowed"),
        ("__builtins__['open']", 16, "`__builtins__` is not allowed"),
        ("x = (i for i in ()).gi_frame", 16, "`.gi_frame`"),
        ("np.ones(3).tofile('x')", 16, "`.tofile`"),
        ("np.ones(3).ctypes", 16, "`.ctypes`"),
        ("e = eval", 16, "`eval`"),
        ("x = getattr(math, 'pi')", 16, "`getattr`"),
        ("def f():\n    global x", 17, "`global`"),
        ("class A:\n    def __array_interface__(self):\n        pass", 17, "`__array_interface__`"),
        ("match 1:\n    case int(__class__=c):\n        pass", 16, "`match`"),
        ("class A:\n    match {}:\n        case __dict__:\n            pass", 17, "`match`"),
        ("try:\n    1\nexcept ValueError as __name__:\n    1", 16, "`try`"),
        ("import math as __array_struct__", 16, "`__array_struct__`"),
        ("from math import __loader__ as a", 16, "`__loader__`"),
        ("match np.ones(3):\n    case np.ndarray(ctypes=c):\n        pass", 16, "`match`"),
        ("import numpy as m\nif 0:\n    import math as m", 16, "`m` with two meanings"),
        ("def f(math):\n    return math.x", 2, "`math` with two meanings"),
        ("license._Printer__filenames = ['/etc/passwd']", 16, "`._Printer__filenames`"),
        ("x = license", 16, "`license`"),
        ("exit()", 16, "`exit`"),
        ("x = '{0.__init__.__globals__}'.format(Parameter)", 16, "`.format`"),
        ("np.ones(3).resize((9,), refcheck=False)", 16, "`.resize`"),
        ("np.ones(3).data", 16, "`.data`"),
        ("x = Law.mro()", 16, "`.mro`"),
        ("x = Law._line", 16, "`._line`"),
        ("with np.ones(3) as x:\n    pass", 16, "`with`"),
        ("async def f():\n    pass", 16, "`asyncfunctiondef`"),
        ("x = (", 16, "is not Python"),
        ("x = '\0'", 1, "is not Python"),
    ],
)
def test_what_could_do_more_is_refused(more: str, line: int, said: str, tmp_path: Path) -> None:
    path = written(tmp_path, LAW.rstrip() + "\n" + more + "\n")
    with pytest.raises(EffectError, match=said) as caught:
        check_untrusted(path)
    assert caught.value.line == line


@given(st.text(max_size=80))
def test_any_text_is_allowed_or_refused(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    path = tmp_path_factory.mktemp("any") / "x.py"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        check_untrusted(path)
    except EffectError as error:
        assert error.path == path

"""The reference of checks in docs is what the lab asks."""

import re
from pathlib import Path

from tools.figures import checks_reference

ROOT = Path(__file__).parents[2]


def test_every_warning_that_the_lab_gives_is_listed() -> None:
    """A code that no table has would be met by a reader who finds nothing of it."""
    source = (ROOT / "cell/lab/verdict/doubts.py").read_text(encoding="utf-8")
    codes = set(re.findall(r'Doubt\(\s*"(\w+)"', source))
    listed = checks_reference.of_diagnosis()
    assert codes
    assert all(f"`{code}`" in listed for code in codes)

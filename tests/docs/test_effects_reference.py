"""The catalogue of effects against the code, its pictures and its table of confusions."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cable.effects import library, unscreened
from cell.cli import app
from tools.figures.effect_confusions import motions, signatures
from tools.figures.effect_pictures import main

ROOT = Path(__file__).parents[2]
EFFECTS = library() | unscreened()
TABLE = ROOT / "docs" / "measured" / "effect_confusions.csv"
LARGEST_PICTURE = 45_000
#: What the page calls a motion, and its name in the table.
MOTIONS = {
    "with a stroke to the left": "down and left",
    "with a tilted clamp": "down and tilted",
    "with the stroke repeated at a clamp angle of −0.9 rad": "down and tilted",
    "where the clamp turns in addition": "down and turn",
    "where a second, upward stroke follows": "down_up",
    "on a stroke to the left": "left",
    "if all strokes go left": "left",
}
_PARAMETER = re.compile(
    r"^- `([^`]+)`: (?:\$[^$]+\$ )?from (\S+) to ([^\s,]+)(?: ([^\s,]+))?, .+[.]$", re.MULTILINE
)
_CONFUSED = re.compile(r"`(\w+)`\s\((\d\.\d\d)(?:; (below )?(\d\.\d+) ([^)]+))?\)")


def entries():
    """Text of each entry by its heading."""
    text = (ROOT / "docs" / "reference" / "effects.md").read_text("utf-8")
    _, *parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


ENTRIES = entries()


def test_each_effect_has_an_entry_in_the_order_of_the_code():
    assert list(ENTRIES) == list(EFFECTS)


def named(name):
    """A line may stand for several parameters: `a_{0…2}_b`."""
    some = re.search(r"\{(\d)…(\d)\}", name)
    if some is None:
        return [name]
    low, high = map(int, some.groups())
    return [name.replace(some[0], str(i)) for i in range(low, high + 1)]


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=list(EFFECTS))
def test_parameters_units_and_limits_are_those_of_the_code(effect):
    told = [
        (name, unit or "1", float(low), float(high))
        for names, low, high, unit in _PARAMETER.findall(ENTRIES[effect.name])
        for name in named(names)
    ]
    assert told == [(p.name, p.unit, p.low, p.high) for p in effect.parameters]
    given = re.findall(r"^- `(\w+)`[^\n]+, not fitted", ENTRIES[effect.name], re.MULTILINE)
    assert given == [p.name for p in effect.parameters if not p.fitted]


@pytest.mark.parametrize("name", EFFECTS)
def test_each_entry_has_its_law_and_a_small_picture(name):
    assert "$$" in ENTRIES[name]
    assert f"![{name}: " in ENTRIES[name]
    assert f"](../images/effects/{name}.png)" in ENTRIES[name]
    picture = ROOT / "docs" / "images" / "effects" / f"{name}.png"
    assert 5_000 < picture.stat().st_size < LARGEST_PICTURE


def test_confusions_are_those_of_the_table():
    with TABLE.open(encoding="utf-8") as file:
        rows = {
            (r["motion"], r["effect"], r["other"]): r["correlation"] for r in csv.DictReader(file)
        }
    wrong, compared = [], 0
    for name, text in ENTRIES.items():
        for other, first, below, second, words in _CONFUSED.findall(" ".join(text.split())):
            compared += 1
            if rows.get(("down", name, other)) != first:
                wrong.append((name, other, first, rows.get(("down", name, other))))
            if second:
                there = rows.get((MOTIONS[words], name, other), "0.29")
                if not (float(there) < float(second) if below else there == second):
                    wrong.append((name, other, words, second, there))
    assert not wrong
    assert compared > 20


def test_the_table_is_what_its_program_computes():
    with TABLE.open(encoding="utf-8") as file:
        (row,) = [
            r
            for r in csv.DictReader(file)
            if (r["motion"], r["effect"], r["other"]) == ("rest", "grip_angle", "grip_compliance")
        ]
    found = signatures(motions()["rest"])
    seen = np.linalg.svd(found["grip_angle"].T @ found["grip_compliance"], compute_uv=False)[0]
    assert f"{seen:.2f}" == row["correlation"]
    assert "robot_lag" not in found, "nothing moves"


def test_the_list_of_effects_names_the_catalogue():
    said = CliRunner().invoke(app, ["effects", "--help"]).stdout
    assert "cell help effects" in " ".join(said.split())


def test_a_picture_is_drawn(tmp_path, capsys):
    main(["--only", "robot_lag", "--out", str(tmp_path)])
    drawn = (tmp_path / "robot_lag.png").read_bytes()
    assert drawn.startswith(b"\x89PNG")
    assert 5_000 < len(drawn) < LARGEST_PICTURE
    assert "robot_lag: delay_s = 0.005 s: tip moved by up to 3 mm" in capsys.readouterr().out

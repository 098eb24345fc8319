"""Inputs that somebody has spoilt: no traceback, no hang, no harm; errors name place and remedy.

Good files are changed at random, repeatably.  `make malformed` tries more of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import cv2
import numpy as np
import pytest

from cell.cable.model import CableModel
from cell.files.yaml_document import yaml_text
from cell.identify.individual import identify
from cell.lab.data import named_effects
from cell.lab.next import discover
from cell.lab.next.terms import admissible
from cell.settings import load_settings
from cell.settings.promotion import line_identity
from cell.settings.translate import model_hash
from cell.study.data import Study, Trial
from cell.study.folder import write_study
from tests.command import run_cell
from tools.worlds.made_studies import CABLE, filmed, moved

from .conftest import run

CASES = int(os.environ.get("MALFORMED_CASES", "60"))
#: Computing after which a command counts as hung, s.
HUNG_S = 10.0
MOST_BYTES = 1024**3

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"

MOTION = """format: cell-motion/1
purpose: tell air_drag from draught
start: {x_m: 0.0, y_m: 0.0, angle_rad: 0.0}
still_s: 0.2
moves:
- {x_m: 0.0, y_m: -0.05, angle_rad: 0.0, duration_s: 0.5}
hold_s: 1.0
"""

EFFECT = '''"""A magnet beside the path."""

from cell.cable.effects import Effect, Parameter


class Magnet(Effect):
    """Pull towards a place."""

    name = "magnet"
    parameters = (
        Parameter("strength_n_m", "N·m", 0.0, 1e-3, default=0.0, starts=(2e-5,)),
        Parameter("x_m", "m", -1.0, 1.0, default=-0.1, starts=(-0.1,), amplitude=False),
    )

    def force(cable, at, p):
        dx = p.x_m - at.x
        return p.strength_n_m * dx / (dx * dx + 1e-4), 0.0
'''

VALUES = (
    "nan", ".nan", "inf", "-.inf", "-1", "0", "1e308", "-1e308", "1e-320", "true", "null", "~",
    "''", "'1'", "[]", "{}", "[1, 2, 3]", "1e6", "12 mm", "0x10", "1_0", "9" * 5000, "x" * 3000,
    "\u200b", "\x1b[2J", "*a", "&a [*a]", "!!python/name:os.system", "2020-13-45", "-", "1,5", "☃",
)  # fmt: skip

Change = Callable[[random.Random, bytes], bytes]


def _lines(change: Callable[[random.Random, list[bytes]], list[bytes]]) -> Change:
    return lambda rng, data: b"\n".join(change(rng, data.split(b"\n")))


def _pick(rng: random.Random, data: bytes, what: Callable[[bytes], bool]) -> tuple[int, int]:
    """Where a word of a kind stands."""
    separators = b" ,:\n[]{}()\"'"
    starts = [i for i in range(len(data)) if i == 0 or data[i - 1] in separators]
    words = []
    for i in starts:
        end = i
        while end < len(data) and data[end] not in separators:
            end += 1
        if end > i and what(data[i:end]):
            words.append((i, end))
    return rng.choice(words or [(0, 0)])


def _is_number(word: bytes) -> bool:
    return word[:1].isdigit() or word[:1] in (b"-", b".")


def other_value(rng: random.Random, data: bytes) -> bytes:
    i, end = _pick(rng, data, _is_number)
    return data[:i] + rng.choice(VALUES).encode() + data[end:]


def other_size(rng: random.Random, data: bytes) -> bytes:
    i, end = _pick(rng, data, _is_number)
    try:
        value = float(data[i:end])
    except ValueError:
        return other_value(rng, data)
    factor = rng.choice([-1.0, 1e3, 1e-3, 57.3, 1e9, 1e-9, 2.0, 0.0])
    return data[:i] + repr(value * factor).encode() + data[end:]


def other_word(rng: random.Random, data: bytes) -> bytes:
    i, end = _pick(rng, data, bytes.isalpha)
    word = bytearray(data[i:end])
    rng.shuffle(word)
    return data[:i] + bytes(word) + data[end:]


def noise(rng: random.Random, data: bytes) -> bytes:
    spoilt = bytearray(data)
    for _ in range(rng.choice([1, 3, 30])):
        spoilt[rng.randrange(len(spoilt))] = rng.randrange(256)
    return bytes(spoilt)


CHANGES: dict[str, Change] = {
    "other value": other_value,
    "other size": other_size,
    "other word": other_word,
    "noise": noise,
    "line left out": _lines(lambda r, t: [x for i, x in enumerate(t) if i != r.randrange(len(t))]),
    "line twice": _lines(lambda r, t: [y for x in t for y in [x] * r.choice([1, 1, 1, 2])]),
    "lines exchanged": _lines(lambda r, t: r.sample(t, len(t))),
    "line indented": _lines(lambda r, t: [r.choice([b"", b"", b" ", b"\t"]) + x for x in t]),
    "cut": lambda r, d: d[: r.randrange(len(d))],
    "empty": lambda r, d: b"",
    "repeated": lambda r, d: d * r.choice([2, 50, 3000]),
    "deep": lambda r, d: d + r.choice([b"[", b"{a: ", b'{"a":', b"(", b"- "]) * 20_000,
    "another encoding": lambda r, d: d.decode().encode(r.choice(["utf-16", "utf-8-sig", "cp037"])),
    "windows": lambda r, d: d.replace(b"\n", b"\r\n"),
    "zeros": lambda r, d: d[:50] + bytes(1000) + d[50:],
    "very many keys": lambda r, d: d + b"".join(b"\nk%d: 1" % i for i in range(9_000)),
    "bomb": lambda r, d: (
        d + b"\na0: &a0 [x, x]\n"
        + b"".join(b"a%d: &a%d [*a%d, *a%d, *a%d]\n" % (i, i, i - 1, i - 1, i - 1)
                   for i in range(1, 30))
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory, quick_config: Path) -> Path:
    """A folder with a good file of every kind."""
    folder = tmp_path_factory.mktemp("good")
    t = np.arange(0.0, 0.8, 0.01)
    grip, arcs = moved(t, (0.0, -0.05), 0.2), np.linspace(0.1, 0.0, 3)
    model = CableModel.uniform(CABLE, 3e-5, viscosity_n_m2_s=1e-7)
    seen = filmed(np.random.default_rng(1), model, grip, t, arcs)
    trial = Trial("a", "fit", "equilibrium", grip, seen)
    write_study(Study("s", CABLE, arcs, (trial,)), folder / "study")
    identified = identify(trial, arcs, CABLE)
    (folder / "model.json").write_text(json.dumps(identified.to_dict(), indent=1))
    shutil.copy(CONFIG, folder / "settings.yaml")
    (folder / "motion.yaml").write_text(MOTION)
    (folder / "effect.py").write_text(EFFECT)
    content = {
        "format": "cell-candidate/1",
        "beside": model_hash(load_settings(CONFIG).model),
        "lines": [line_identity(load_settings(CONFIG))],
        "model": {
            "effects": [{"effect": "air_drag", "parameters": {"drag_coefficient": {"fixed": 1.9}}}]
        },
        "gates": [{"gate": "forecasts unseen cables better", "passed": True, "found": "so"}],
    }
    (folder / "candidate.yaml").write_text(yaml_text(content))
    (folder / "pictures").mkdir()
    cv2.imwrite(str(folder / "pictures" / "board_01.png"), np.full((40, 50), 90, np.uint8))
    text = CONFIG.read_text()
    (folder / "calibrated.yaml").write_text(text + "\ncalibration: {}\n")
    runs = folder / "runs"
    run_cell("run", "-c", quick_config, "--runs", runs)
    (cycle,) = runs.iterdir()
    shutil.copytree(cycle, folder / "cycle", ignore=shutil.ignore_patterns("*.jpg"))
    shutil.rmtree(runs)
    return folder


STUDY = ("study/study.yaml", "study/a/markers.csv", "study/a/grip.csv")
#: What the commands read, and how they are given it; {0} is the folder.  Those that compute long
#: with a good study are given one that is small, few rivals and few terms.
COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "check": ("check -c {0}/settings.yaml", ("settings.yaml",)),
    "study": ("study {0}/study -o {0}/out", STUDY),
    "identify": ("identify {0}/study -o {0}/out", STUDY),
    "identify with settings": ("identify {0}/study -c {0}/settings.yaml", ("settings.yaml",)),
    "effects": ("effects --try {0}/effect.py -o {0}/out", ("effect.py",)),
    "compare": ("compare {0}/study --model {0}/model.json -o {0}/out", ("model.json", *STUDY)),
    "fit": (
        "fit {0}/study --with {0}/effect.py -c {0}/settings.yaml -o {0}/out",
        (*STUDY, "effect.py", "settings.yaml"),
    ),
    "fit with a prior": ("fit {0}/study --prior {0}/model.json -o {0}/out", ("model.json",)),
    "diagnose": ("diagnose {0}/study -o {0}/out --report {0}/page.html", STUDY),
    "diagnose with a prior": ("diagnose {0}/study --prior {0}/model.json", ("model.json",)),
    "discover": ("discover {0}/study -o {0}/law.py", STUDY),
    "suggest": (
        "suggest {0}/study -c {0}/settings.yaml -o {0}/out",
        (*STUDY, "settings.yaml"),
    ),
    "learn": (
        "learn {0}/cycle -c {0}/cycle/settings.yaml -o {0}/out",
        ("cycle/settings.yaml", "cycle/state.json", "cycle/result.json", "cycle/study/study.yaml"),
    ),
    "promote": (
        "promote {0}/candidate.yaml -c {0}/settings.yaml",
        ("candidate.yaml", "settings.yaml"),
    ),
    "calibrate": (
        "calibrate camera -c {0}/calibrated.yaml --from {0}/pictures",
        ("calibrated.yaml", "pictures/board_01.png"),
    ),
    "measure": (
        "run -c {0}/cycle/settings.yaml --motion {0}/motion.yaml --runs {0}/runs",
        ("motion.yaml",),
    ),
    "list": ("list {0}", ("cycle/state.json", "cycle/result.json")),
    "show": ("show {0}/cycle", ("cycle/state.json", "cycle/result.json")),
}

#: A command and the file that is spoilt.
CASES_OF = [(command, kind) for command, (_, kinds) in COMMANDS.items() for kind in kinds]
#: Which find nothing to do where all is good: too few cycles or pictures, a complete model.
TOO_LITTLE = {"learn", "calibrate", "discover", "suggest"}
#: What to do, where a clause begins; or what would be right.
REMEDY = re.compile(
    r"(?:[;:,.]|\b(?:and|or)) (?:add|calibrate|check|close|correct|count|cut|give|indent|keep|"
    r"learn|leave|look|make|measure|mend|name|quote|record|remove|rename|run|save|sort|take|use|write)\b|"
    r"\b(?:must|should|needs?|allowed|limit|known: |did you mean|at (?:most|least)|not \S+ … \S+)",
    re.IGNORECASE,
)


@contextmanager
def hung_after(seconds: float) -> Iterator[None]:
    """Fails if what is done takes more computing than this; waiting does not count."""

    def fail(number: int, frame: FrameType | None) -> None:
        pytest.fail(f"hung: more than {seconds} s of computing")

    former = signal.signal(signal.SIGVTALRM, fail)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, former)


def _contents(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def _outcome(command: str, folder: Path) -> tuple[int, str]:
    """Exit code and error output of a command."""
    words, _ = COMMANDS[command]
    done = run(*(w.format(folder) for w in words.split()))
    return done.returncode, done.stderr


def _check(command: str, folder: Path) -> None:
    before = _contents(folder)
    held = _memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew: other tests left theirs
    with hung_after(HUNG_S):
        code, said = _outcome(command, folder)
    after = _contents(folder)
    wrote = {name for name in after if name not in before and not name.endswith(".log")}
    kept = before if command != "promote" or code else before | {"settings.yaml": None}
    assert {n: after.get(n) for n, v in kept.items() if v} == {
        n: v for n, v in kept.items() if v
    }, "a file was harmed"
    assert code in (0, 1, 2)
    assert "Traceback" not in said
    if code == 2:
        assert not wrote, "nothing may be written"
        assert str(folder) in said or "study s: " in said, f"no place is named: {said}"
        # the folder's own name has words in it
        told = said.replace(str(folder), "")
        assert REMEDY.search(told), f"no remedy is named: {told}"
        assert len(said) < 20_000
        assert said.isprintable() or all(c.isprintable() or c == "\n" for c in said)
    taken = _memory("VmHWM") - held
    assert taken < MOST_BYTES, f"{taken / 1e9:.2f} GB of memory"


def _memory(entry: str) -> int:
    """Of this process, bytes: VmRSS = now, VmHWM = at most since its peak was last cleared."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{entry}:"))


@pytest.fixture(autouse=True)
def little_computing(monkeypatch: pytest.MonkeyPatch) -> None:
    """One rival and one term: what is good is soon computed."""
    known = named_effects.library()
    monkeypatch.setattr(named_effects, "library", lambda: {"tip_mass": known["tip_mass"]})
    monkeypatch.setattr(
        discover, "admissible", lambda box: [t for t in admissible(box) if t.name == "drag_along"]
    )


def test_a_place_or_a_cause_is_no_remedy() -> None:
    for said in (
        "/refused_with_its_place_or_used/study/a/markers.csv:4: has 8 cells, the header has 7",
        "effect.py:1: UnicodeDecodeError: 'utf-8' codec can't decode byte 0xa8 in position 0",
        "grip.csv:3: y_m: 'x' is not a number; not seen = nan or empty",
        "settings.yaml:3:1: cannot be read",
    ):
        assert not REMEDY.search(said)
    assert REMEDY.search("cycle/state.json:1:1: is not UTF-8 text; save it as UTF-8")


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_good_is_taken(good: Path, tmp_path: Path, command: str) -> None:
    shutil.copytree(good, tmp_path / "case")
    code, said = _outcome(command, tmp_path / "case")
    assert code == 0 or command in TOO_LITTLE, said


@pytest.mark.parametrize("case", range(CASES))
def test_a_spoilt_file_is_refused_with_its_place_or_used(
    good: Path, tmp_path: Path, case: int
) -> None:
    rng = random.Random(case)
    (command, kind), change = rng.choice(CASES_OF), rng.choice(sorted(CHANGES))
    shutil.copytree(good, tmp_path / "case")
    path = tmp_path / "case" / kind
    data = path.read_bytes()
    if change == "another encoding" and kind.endswith(".png"):
        change = "noise"
    path.write_bytes(CHANGES[change](rng, data))
    _check(command, tmp_path / "case")


@pytest.mark.parametrize("instead", ["folder", "pipe", "device", "nothing"])
@pytest.mark.parametrize(
    "kind", sorted({k for _, k in CASES_OF if not k.startswith(("cycle", "pictures"))})
)
def test_what_is_no_file_is_refused(good: Path, tmp_path: Path, kind: str, instead: str) -> None:
    command = next(c for c, k in CASES_OF if k == kind)
    shutil.copytree(good, tmp_path / "case")
    path = tmp_path / "case" / kind
    path.unlink()
    if instead == "folder":
        path.mkdir()
    elif instead == "pipe":
        os.mkfifo(path)
    elif instead == "device":
        path.symlink_to("/dev/zero")
    _check(command, tmp_path / "case")
    assert _outcome(command, tmp_path / "case")[0] == 2

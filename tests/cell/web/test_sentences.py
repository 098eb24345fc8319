"""Sentences of the program in other languages: all that the source shows, with any values."""

from __future__ import annotations

import ast
import re
import time
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import cell.web
from cell.cable.solver import DivergedError
from cell.identify.individual import CableRejectedError, Reason
from cell.run.plans import INSERTING
from cell.settings import Settings
from cell.vision.sighting import Unseen
from cell.web.wording import (
    LONGEST,
    Placeholder,
    Sentences,
    Translation,
    catalogue,
    languages,
    parts_of,
    preferred,
    read_po,
    sentences,
    translation,
)
from drivers.interfaces import ArmMode
from drivers.ur_versions import SupportLevel
from tests.cell.web.sentences import (
    CALLS,
    Hole,
    Sentence,
    errors_of_the_source,
    of_text,
    said_by_the_source,
)

#: Words that are said as they are in every language: names of settings and their values.
AS_THEY_ARE = {"PixelFormat", "Mono8", "Width", "Off", "fourcc", "auto_exposure", "manual"}
AS_THEY_ARE |= {"exposure_s", "frame_rate_hz", "config"}
WORD = re.compile(r"[^\W\d]\w*")


def texts_of(sentence: Sentence) -> Iterator[str]:
    """The sentence with values: what has no format may be a text or a number."""
    places = [p for p in sentence.parts if isinstance(p, Hole)]
    choices = [["1.25"] if p.number else ["⟨1⟩", "11"] for p in places]
    for values in islice(product(*choices), 64):
        given = iter(values)
        parts = (p if isinstance(p, str) else next(given) + "%" * p.percent for p in sentence.parts)
        yield "".join(parts).strip("; ")


def is_whole(found: Translation | None) -> bool:
    """Whether a text is translated, and nothing of it is taken for a value but values."""
    return found is not None and not set(WORD.findall(" ".join(found.untranslated))) - AS_THEY_ARE


@pytest.mark.parametrize("language", languages()[1:])
def test_every_sentence_that_the_source_says_is_in_the_catalogue(language: str) -> None:
    say = sentences(language)
    said = {s.shape: s for s in said_by_the_source()}
    lacking = [
        f'{s.where}: msgid "{s.shape}"'
        for s in said.values()
        if not any(is_whole(say.find(text)) for text in texts_of(s))
    ]
    assert len(said) > 350, "the sentences of the source are no longer found"
    assert not lacking, (
        f"add to cell/web/locales/{language}/LC_MESSAGES/cell.po, with a name for each value, as "
        f"{{miss:number}}, {{cause:sentence}} or {{name}}:\n" + "\n".join(lacking)
    )


@pytest.mark.parametrize("language", languages()[1:])
def test_a_translation_has_the_places_of_its_message(language: str) -> None:
    for message, said in catalogue(language).items():
        if not message:  # the head
            continue
        asked = [p.name for p in parts_of(message) if isinstance(p, Placeholder)]
        given = [p.name for p in parts_of(said) if isinstance(p, Placeholder)]
        assert sorted(asked) == sorted(set(given)) == sorted(given), message
        assert not re.search(r"\}\{", message), f"{message}: nothing tells one value's end"


def test_a_sentence_without_a_translation_is_noticed() -> None:
    (new,) = of_text('raise GripError("gripper", f"the jaws are {gap:.1f} mm too wide")')
    assert [sentences("de").find(text) for text in texts_of(new)] == [None]
    assert new.shape == "the jaws are {…} mm too wide"


def test_every_kind_of_error_is_looked_at() -> None:
    unknown = {where: name for name, where in errors_of_the_source() if name not in CALLS}
    assert not unknown, "add these to CALLS in tests/cell/web/wording.py"


def test_the_source_is_read_with_constants_choices_and_helpers() -> None:
    source = """
REMEDY = "look"
def why(n):
    return f"{n} are left" if n else "none is left"
def act(name, n):
    cause = f"{name}: {why(n)}"
    if n > 3:
        cause += f"; {n:.1f} mm"
    raise GripError("gripper", cause, REMEDY)
"""
    found = {s.shape for s in of_text(source)}
    assert found == {"{…}: {…} are left", "{…}: none is left", "; {…} mm", "look"}


@pytest.mark.parametrize(
    "text",
    [
        *(str(CableRejectedError(r, "the tip swings by 1.00 mm, needs 2.00")) for r in Reason),
        *(f"is in {m.value.replace('_', ' ')}" for m in ArmMode if m is not ArmMode.READY),
        *(f"stopped: {m.value}" for m in ArmMode if m is not ArmMode.READY),
        *(f"no pictures; {u.value.replace('_', ' ')} in 2, empty in 1" for u in Unseen),
        *(f"failed in step {s.name}: still moving" for s in INSERTING.steps),
        str(DivergedError([0], 0.1, 0.001)),
        *(
            f"the controller runs PolyScope 5, {k}: too hot"
            for k in SupportLevel
            if k is not SupportLevel.PROVED
        ),
    ],
)
def test_words_of_the_program_are_known_in_its_sentences(text: str) -> None:
    found = sentences("de").find(text)
    assert found is not None
    assert set(found.untranslated) <= {"5"}


# --- matching -----------------------------------------------------------------------------------

MESSAGES = {
    "the tip missed the destination by {miss:number} mm": "Ziel um {miss} mm verfehlt",
    "no gripper on {port}: {cause:sentence}": "{cause} – kein Greifer an {port}",
    "at most {most:number} of {name} in {place}": "in {place} höchstens {most} {name}",
    "{name} is missing": "{name} fehlt",
    "is in {mode:sentence}": "ist in „{mode}“",
    "protective stop": "Schutzhalt",
    "empty the jaws": "Greifer leeren",
}
SAY = Sentences(MESSAGES, decimal=",")
LITERALS = [p for m in MESSAGES for p in parts_of(m) if isinstance(p, str)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("empty the jaws", "Greifer leeren"),
        ("the tip missed the destination by 1.20 mm", "Ziel um 1,20 mm verfehlt"),
        ("is in protective stop", "ist in „Schutzhalt“"),
        ("is in doubt", "ist in „doubt“"),
        ("is in protective stop; empty the jaws", "ist in „Schutzhalt“; Greifer leeren"),
        ("is in protective stop; unknown", "ist in „protective stop; unknown“"),
        ("empty the jaws; unknown", "empty the jaws; unknown"),
        ("a; b is missing. empty the jaws", "a; b fehlt. Greifer leeren"),
        ("no gripper on /dev/x: empty the jaws", "Greifer leeren – kein Greifer an /dev/x"),
        ("the tip missed the destination by far mm", "the tip missed the destination by far mm"),
        ("The tip missed the destination by 1 mm", "The tip missed the destination by 1 mm"),
        ("at most nan of 5.26 in x", "in x höchstens nan 5.26"),
    ],
)
def test_a_sentence_is_translated_with_its_values_or_stays_as_it_is(text: str, said: str) -> None:
    assert SAY(text) == said


#: Values without what messages say: nobody can tell which is which.
VALUES = (
    st.text(max_size=40) | st.text(st.sampled_from("{}()[].*+?^$|\\%\n; :<>&'\"äx0"), max_size=30)
).filter(lambda text: not any(literal in text for literal in LITERALS))


@given(VALUES, VALUES, st.floats(0, 1e6))
def test_any_values_come_back(name: str, place: str, most: float) -> None:
    assume(f"{name} in ".index(" in ") == len(name))
    number = f"{most:.2f}"
    text = f"at most {number} of {name} in {place}"
    assert SAY(text) == f"in {place} höchstens {number.replace('.', ',')} {name}"


@given(VALUES, VALUES)
def test_values_are_no_templates_and_no_patterns(port: str, cause: str) -> None:
    assume(f"{port}: ".index(": ") == len(port))
    assert SAY(f"no gripper on {port}: {cause}") == f"{cause} – kein Greifer an {port}"


@given(VALUES)
def test_what_no_message_says_stays_as_it_is(text: str) -> None:
    assert SAY(text) == text


@pytest.mark.parametrize(
    "text",
    [
        " of " * 400 + "x",
        "is in " * 330,
        "empty the jaws; " * 100,
        "no gripper on : " * 120,
        " is missing. " * 150,
        "x" * (LONGEST + 1) + " is missing",
    ],
)
def test_no_text_takes_long(text: str) -> None:
    say = sentences("de")
    begun_s = time.process_time()
    say(text)
    SAY(text)
    assert time.process_time() - begun_s < 0.5


def test_a_text_is_looked_up_once() -> None:
    say = Sentences(catalogue("de"))
    begun_s = time.process_time()
    for _ in range(20_000):
        say("the tip missed the destination by 1.2 mm")
    assert time.process_time() - begun_s < 0.5


def test_the_catalogue_names_its_decimal_sign() -> None:
    say = translation("de")
    assert say("+1.20 mm") == "+1,20 mm"
    assert say("the tip missed the destination by 1.20 mm") == (
        "die Spitze verfehlte das Ziel um 1,20 mm"
    )


FOLDER = Path(cell.web.__file__).parent


def messages() -> set[str]:
    """Constants that are given to a function that translates or marks."""
    found = set()
    for file in FOLDER.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            name = node.func.id if isinstance(node.func, ast.Name) else name
            if name in ("t", "_t", "N_") and isinstance(node.args[0], ast.Constant):
                found.add(node.args[0].value)
    return found


@pytest.mark.parametrize("language", languages()[1:])
def test_a_catalogue_has_every_message_of_the_source(language: str) -> None:
    known = catalogue(language)
    assert messages() - {m for m, said in known.items() if said} == set()


def explanations(node: object) -> Iterator[str]:
    """First paragraphs of all descriptions in a JSON schema."""
    inside = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    if isinstance(node, dict) and isinstance(node.get("description"), str):
        yield " ".join(node["description"].split("\n\n")[0].split())
    for each in inside:
        yield from explanations(each)


@pytest.mark.parametrize("language", languages()[1:])
def test_a_catalogue_explains_every_setting(language: str) -> None:
    say = translation(language)
    untranslated = [e for e in explanations(Settings.model_json_schema()) if say(e) == e]
    assert untranslated == []


def test_a_catalogue_is_read_with_long_and_quoted_messages() -> None:
    text = 'msgid ""\nmsgstr "head\\n"\n# said\nmsgid "a \\"b\\""\nmsgstr ""\n"c"\n" d"\n'
    assert read_po(text) == {"": "head\n", 'a "b"': "c d"}


def test_the_language_is_the_first_that_there_is() -> None:
    assert preferred("fr, de-CH;q=0.9, en;q=0.8") == "de"
    assert preferred("") == "en"
    assert translation("de")("Stop") == "Stopp"
    assert translation("xx/../de")("Stop") == "Stop"

"""What the text of a diagnosis says against the numbers beside it: each sentence is recomputed.

`contradictions(found, text)` takes the JSON (cable-diagnosis/1) and what was printed; it uses none
of the project's own words.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

Found = Mapping[str, Any]

#: Family-wise level at which a diagnosis calls something beyond chance.
SIGNIFICANT = 0.01
#: Up to so many times the noise an error may be called noise.
NOISE_ALONE = 1.10
#: How each verdict's sentence reads.
HEADLINES = {
    "complete": r"^The model is complete: ",
    "unexplained": r"[Nn]o effect that was tried|no effect was looked for",
    "missing": r" with .+ in it ",
    "cannot_tell": r"[Tt]hese motions cannot (?:tell|show)|too few to decide|not confirmed"
    r"|(?:does|do) not confirm|cannot identify its cause|^Interrupted",
}
NUMBER = r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)"


def contradictions(found: Found, text: str) -> list[str]:
    """What in a printed diagnosis its own numbers deny; nothing if all is one."""
    return [said for check in CHECKS for said in check(found, text)]


def headline(text: str) -> str:
    """The first line."""
    return text.strip().splitlines()[0]


def plain(name: str) -> str:
    return name.replace("_", " ")


def shows(shown: str, value: float) -> bool:
    """Whether a number as printed is this value, rounded."""
    decimals = len(shown.split(".")[1]) if "." in shown and "e" not in shown else 0
    return abs(float(shown) - value) <= 0.51 * 10.0**-decimals or (
        abs(float(shown) / value - 1.0) < 0.06 if value else float(shown) == 0.0
    )


def error_mm(errors: Found) -> float | None:
    """Held out, where there is any; in mm."""
    value = errors["heldout_rms_m"]
    value = errors["fit_rms_m"] if value is None else value
    return None if value is None else 1e3 * value


def verdict_and_headline(found: Found, text: str) -> list[str]:
    verdict, first = found["verdict"], headline(text)
    wrong = []
    if not re.search(HEADLINES[verdict], first):
        wrong.append(f"the verdict is {verdict}, and the sentence: {first}")
    if f"Verdict {verdict}:" not in text:
        wrong.append(f"the verdict {verdict} is not said")
    if bool(found["missing"]) and verdict not in ("missing", "cannot_tell"):
        wrong.append(f"{verdict}, and effects are missing")
    if found["partial"] and verdict != "unexplained":
        wrong.append(f"{verdict}, and effects explain in part")
    for effect in (*found["missing"], *found["partial"]):
        if plain(effect["effect"]) not in first:
            wrong.append(f"{effect['effect']} is named, and not in the sentence")
    if verdict == "complete" and re.search("The model misses", first):
        wrong.append("complete, and misses")
    return wrong


def numbers_of_the_sentence(found: Found, text: str) -> list[str]:
    first, wrong = headline(text), []
    expected: list[tuple[str, float | None]] = [
        (rf"The model misses {NUMBER} mm", error_mm(found["baseline"])),
        (rf"what it misses \({NUMBER} mm\)", error_mm(found["baseline"])),
        (rf"camera noise(?: is)? \(?{NUMBER} mm", 1e3 * found["noise_m"]),
        (rf"stated error of (?:the measurement is )?{NUMBER} mm", 1e3 * found["noise_m"]),
        (rf"stated error of the measurement \({NUMBER} mm\)", 1e3 * found["noise_m"]),
    ]
    if found["missing"]:
        after = error_mm(found["missing"][-1])
        expected.append((rf" in it {NUMBER} mm:", after))
        times = re.search(rf"mm: {NUMBER} times the noise", first)
        if times and after is not None and not shows(times[1], after / (1e3 * found["noise_m"])):
            wrong.append(f"“{times[0]}”, and {after:.4g} mm over {1e3 * found['noise_m']:.4g} mm")
    left = found["left"]
    if left is not None and found["verdict"] == "unexplained":
        before, after = 1e3 * left["before_rms_m"], 1e3 * left["rms_m"]
        expected += [
            (rf"fitted to all trials the model misses {NUMBER} mm", before),
            (rf"Fitted to all trials it misses {NUMBER} mm", before),
            (rf"without (?:it|them) and {NUMBER} mm", after),
            (rf", {NUMBER} times the noise, most", left["over_noise"]),
        ]
    for pattern, value in expected:
        said = re.search(pattern, first)
        if said and value is not None and not shows(said[1], value):
            wrong.append(f"“{said[0]}”, and it is {value:.4g}")
    if re.search(r"\d %", first):
        wrong.append("a share in the sentence, where millimetres stand")
    return wrong


def noise_is_called_noise(found: Found, text: str) -> list[str]:
    """Only what is no larger is called noise."""
    errors = found["missing"][-1] if found["missing"] else found["baseline"]
    error, noise = error_mm(errors), 1e3 * found["noise_m"]
    first = headline(text)
    called = re.search(r"(?:is|mm:) (?:camera noise|no larger|within)", first)
    if called and error is not None and error > NOISE_ALONE * noise:
        return [f"“{called[0]}”, and {error:.4g} mm are {error / noise:.2f} times it"]
    stated = found["noise_is_stated"]
    if stated and re.search(r"camera noise is |beyond camera noise", first):
        return ["the noise is stated, and called the camera's"]
    return []


def partial_is_borne_out(found: Found, text: str) -> list[str]:
    status = {r["effect"]: r["status"] for r in found["ranking"]}
    left, noise = found["left"], found["noise_m"]
    wrong = []
    for effect in found["partial"]:
        name = effect["effect"]
        if status.get(name) == "absent":
            wrong.append(f"{name} explains most, and is absent")
        if not effect["p_value"] < SIGNIFICANT:
            wrong.append(f"{name} explains most, at p = {effect['p_value']:.2g}")
        if effect["heldout_rms_m"] is not None:
            wrong.append(f"{name} was fitted to all trials, and one is held out")
    errors = [effect["fit_rms_m"] for effect in found["partial"]]
    if errors and left is not None:
        before = left["before_rms_m"]
        for effect, after in zip(found["partial"], errors, strict=True):
            share = (before**2 - after**2) / (before**2 - noise**2)
            if abs(share - effect["explained_share"]) > 0.02:
                wrong.append(
                    f"{effect['effect']} explains {effect['explained_share']:.2f}, and "
                    f"{before * 1e3:.4g} → {after * 1e3:.4g} mm is {share:.2f}"
                )
        if abs(errors[-1] / left["rms_m"] - 1.0) > 0.01:
            wrong.append(f"{errors[-1]:.4g} m with all in part, and {left['rms_m']:.4g} m left")
        strict = [v for v in (found["baseline"][k] for k in ("fit_rms_m", "heldout_rms_m")) if v]
        if left["rms_m"] > max(strict, default=float("inf")):
            wrong.append(f"{left['rms_m']:.4g} m stay of {max(strict):.4g} m")
        wrong += [f"the error rises from {a:.4g} to {b:.4g} m with one effect more"
                  for a, b in pairwise([before, *errors]) if b > 1.001 * a]  # fmt: skip
    return wrong


def what_stays_is_no_more(found: Found, text: str) -> list[str]:
    """An effect more in a fit leaves no more of what was fitted to."""
    wrong, left, base = [], found["left"], found["baseline"]
    if left is not None and left["rms_m"] > 1.001 * left["before_rms_m"]:
        wrong.append(f"{left['rms_m']:.4g} m stay of {left['before_rms_m']:.4g} m")
    for near in found["nearest"]:
        if left is not None and near["left_rms_m"] > 1.001 * left["before_rms_m"]:
            wrong.append(f"nearest {near['effect']} leaves {near['left_rms_m']:.4g} m of "
                         f"{left['before_rms_m']:.4g} m")  # fmt: skip
        held = base["heldout_rms_m"] is not None and near["heldout_rms_m"] is None
        if held and near["fit_rms_m"] is not None:
            wrong.append(f"nearest {near['effect']} was fitted to all trials: none is held out")
    for effect in found["missing"]:
        if effect["heldout_rms_m"] is not None and base["heldout_rms_m"] is not None:
            before, after = base["heldout_rms_m"], effect["heldout_rms_m"]
            if found["verdict"] == "missing" and after > before:
                wrong.append(
                    f"{effect['effect']} is missing, and held out {before:.4g} → {after:.4g}"
                )
    wrong += [f"{r['effect']} explains χ² {r['score']:.4g}: less than nothing"
              for r in found["ranking"] if r["score"] < -0.05]  # fmt: skip
    return wrong


def statuses(found: Found, text: str) -> list[str]:
    status = {r["effect"]: r["status"] for r in found["ranking"]}
    missing = {e["effect"] for e in found["missing"]}
    tied = {t for e in (*found["missing"], *found["partial"]) for t in e["tied_with"]}
    wrong = [f"{e} is {s}, and {'not ' * (e not in missing)}missing" for e, s in status.items()
             if (s == "present") != (e in missing)]  # fmt: skip
    wrong += [f"{e} is tied with what is named, and absent" for e in tied
              if status.get(e) == "absent"]  # fmt: skip
    limited = {limit["effect"] for limit in found["limits"]}
    wrong += [f"{e} is named, and limited as if it were not" for e in (missing | tied) & limited]
    return wrong


def warnings_and_table(found: Found, text: str) -> list[str]:
    status = {r["effect"]: r["status"] for r in found["ranking"]}
    named = {e["effect"]: e for e in (*found["missing"], *found["partial"])}
    fits = [found["baseline"]["fit_rms_m"], *(e["fit_rms_m"] for e in named.values())]
    if found["left"] is not None:
        fits += [found["left"]["before_rms_m"], found["left"]["rms_m"]]
    wrong = []
    for warning in found["warnings"]:
        code, message = warning["code"], warning["message"]
        if f"Warning: {message}." not in text:
            wrong.append(f"the warning {code} is not printed")
        said = re.search(rf"misses {NUMBER} mm", message)
        if said and not any(f is not None and shows(said[1], 1e3 * f) for f in fits):
            wrong.append(f"“{said[0]}” of {code}, and no error in the table is that")
        if code == "hopeless" and found["partial"]:
            wrong.append("parameters are meaningless, and effects explain most")
        if code == "hopeless" and found["limits"]:
            wrong.append("parameters are meaningless, and effects are excluded beside them")
        if code == "hopeless" and found["agreement"]:
            wrong.append("parameters are meaningless, and trials are asked for them")
        if code == "not_searched" and (found["ranking"] or found["nearest"]):
            wrong.append("no effect was looked for, and effects are listed")
        if code == "not_searched" and "effect that was tried" in text:
            wrong.append("no effect was looked for, and some were tried")
        if code in (
            "possibly_omitted",
            "wider_law",
            "heldout_insensitive",
            "weakly_identified",
            "prior_driven",
        ):
            wrong += [f"{code} of {e}, which is absent" for e, s in status.items()
                      if s == "absent" and re.search(rf"\b{e}\b", message)]  # fmt: skip
        bound = re.match(rf"(\w+)\.(\w+) is at its bound, {NUMBER}", message)
        if bound and bound[1] in named and bound[2] in named[bound[1]]["parameters"]:
            value = named[bound[1]]["parameters"][bound[2]]["value"]
            if not shows(bound[3], value):
                wrong.append(f"“{bound[0]}”, and in the table {value:.4g}")
    return wrong


def next_commands(found: Found, text: str) -> list[str]:
    absent = {r["effect"] for r in found["ranking"] if r["status"] == "absent"}
    asked = {e for line in text.splitlines() if line.startswith("    cell ")
             for e in re.findall(r"--with '?([^\s']+)", line)}  # fmt: skip
    codes = {w["code"] for w in found["warnings"]}
    wrong = [f"the next command fits {e}, which is absent" for e in sorted(asked & absent)]
    if codes & {"hopeless", "not_searched"} and re.search(r"^    cell ", text, re.MULTILINE):
        wrong.append("the study is to be mended first, and a command is offered")
    return wrong


def zeros_have_no_sign(found: Found, text: str) -> list[str]:
    return [f"“{said.group(0)}”" for said in
            re.finditer(r"(?<![\w.^])[-−]0(?:\.0+)?(?![\d.]|e)\b", text)]  # fmt: skip


def chances_are_not_nothing(found: Found, text: str) -> list[str]:
    return ["p = 0"] if re.search(r"p = 0(?![.\d])", text) else []


def columns(text: str, title: str) -> list[dict[str, str]]:
    """Rows of a printed table by its heads; numbers end where their head ends."""
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() == title), None)
    if start is None:
        return []
    head = next(i for i in range(start + 1, len(lines)) if lines[i].strip())
    spans = [(m.group(0), m.start(), m.end()) for m in re.finditer(r"\S+(?: \S+)*", lines[head])]
    rows = []
    for line in lines[head + 2 :]:
        if not line.strip():
            break
        cells = [(m.group(0), m.start(), m.end()) for m in re.finditer(r"\S+(?: \S+)*", line)]
        rows.append(
            {h: c for h, a, b in spans for c, x, y in cells if x == a or y == b}
        )  # fmt: skip
    return rows


def held_out_is_held_out(found: Found, text: str) -> list[str]:
    """Only what was not fitted to stands under "held out"."""
    wrong = []
    known = {f"+ {e['effect']}": e for e in (*found["missing"], *found["partial"])}
    partial = {e["effect"] for e in found["partial"]}
    for row in columns(text, "Error, mm rms per coordinate"):
        name = re.split(r" or ", row.get("model", ""))[0]
        effect, cell = known.get(name), row.get("held out", "–")
        if effect is None:
            continue
        held = effect["heldout_rms_m"]
        if (cell == "–") != (held is None) or (held is not None and not shows(cell, 1e3 * held)):
            wrong.append(f"{name} held out {cell}, and it is {held}")
        if effect["effect"] in partial and row.get("fitted", "–") != "–":
            wrong.append(f"{name} was fitted to all trials, and stands beside those fitted to some")
    for row in columns(text, "Nearest effects, each alone"):
        near = next((n for n in found["nearest"] if n["effect"] == row.get("effect")), None)
        for head, key in (("fitted", "fit_rms_m"), ("held out", "heldout_rms_m")):
            if near is not None and (row.get(head, "–") == "–") != (near[key] is None):
                wrong.append(f"nearest {near['effect']}, {head}: {row.get(head)}, and {near[key]}")
    return wrong


def order_is_of_what_is_shown(found: Found, text: str) -> list[str]:
    rows = columns(text, "Effects, each alone added to the baseline")
    shown = [row["χ² explained"] for row in rows
             if "χ² explained" in row]  # fmt: skip
    values = [float(v) for v in shown]
    return [] if values == sorted(values, reverse=True) else ["effects are not listed by their χ²"]


def _in_code(words: str) -> str:
    """How the name of a parameter begins that a sentence calls so; its unit is in brackets."""
    return re.sub(r" \(.*\)$", "", words).replace(" ", "_")


def trials_agree(found: Found, text: str) -> list[str]:
    wrong = []
    for a in found["agreement"]:
        if a["agrees"] != (a["p_value"] >= SIGNIFICANT):
            wrong.append(f"{a['parameter']}: p = {a['p_value']:.2g}, and agrees: {a['agrees']}")
    said = next((line for line in text.splitlines() if re.match(r"The \d+ trials ", line)), "")
    for a in found["agreement"]:
        on = re.search(r"agree on ([^:]*)\.$", said)
        names = [] if on is None else re.split(r", | and ", on[1])
        name = a["parameter"].replace(".", "_")
        listed = any(name.startswith(_in_code(words)) for words in names)
        if listed != a["agrees"]:
            wrong.append(f"trials agree on {a['parameter']}: {a['agrees']}, and: {said}")
    return wrong


CHECKS: Sequence[Callable[[Found, str], list[str]]] = (
    verdict_and_headline,
    numbers_of_the_sentence,
    noise_is_called_noise,
    partial_is_borne_out,
    what_stays_is_no_more,
    statuses,
    warnings_and_table,
    next_commands,
    zeros_have_no_sign,
    chances_are_not_nothing,
    held_out_is_held_out,
    order_is_of_what_is_shown,
    trials_agree,
)

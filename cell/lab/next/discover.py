"""Discovery of a missing law: terms are fitted to the residual, and confirmed ones are kept."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.effects import Effect, library, load_effect, unscreened
from cell.cable.effects.base import Parameter
from cell.files.atomic import write_atomic
from cell.lab.data.results import Interval
from cell.lab.data.rules import Rules
from cell.lab.diagnosis import diagnose
from cell.lab.next.terms import NAMESPACE, Term, admissible
from cell.lab.search.fit_cache import FitCache, with_joined
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.evidence import Evidence
from cell.study.data import Study, Trial
from cell.study.independence import Independence


def effect_source(
    name: str, terms: Sequence[Term], about: str, values: Mapping[str, float] | None = None
) -> str:
    """Python file with one effect made of terms.

    values  fitted: amplitudes start there, other parameters have them as defaults
    """
    fitted = values or {}
    numbers = [_at(n, fitted) for term in terms for n in term.numbers]
    laws = "\n".join(f"    {t.law[0].upper()}{t.law[1:]}." for t in terms)
    parameters = "\n".join(
        f"        Parameter({n.name!r}, {n.unit!r}, {n.low:.6g}, {n.high:.6g}, {n.default:.8g}, "
        f"({', '.join(f'{s:.8g}' for s in n.starts)},), amplitude={n.amplitude}),"
        for n in numbers
    )
    hooks = "".join(
        _hook(kind, [t for t in terms if t.hook == kind])
        for kind in ("force", "moment")
        if any(t.hook == kind for t in terms)
    )
    title = "".join(part.title() for part in name.split("_"))
    return (
        f'"""{about}"""\n\n'
        "from cell.cable.effects import Effect, Parameter\n\n\n"
        f'class {title}(Effect):\n    """{about}\n\n{laws}\n    """\n\n'
        f"    name = {name!r}\n"
        f"    parameters = (\n{parameters}\n    )\n"
        f"    dissipative = {all(t.dissipative for t in terms)}\n{hooks}"
    )


def _hook(kind: str, terms: Sequence[Term]) -> str:
    head, start, end = {
        "force": ("force(cable, at, p)", "fx, fy = 0.0, 0.0", "return fx, fy"),
        "moment": ("moment(cable, at, m, p)", "moment = 0.0", "return moment"),
    }[kind]
    body = [start, *(line for t in terms for line in t.lines), end]
    return f"\n    @staticmethod\n    def {head}:\n" + "".join(f"        {b}\n" for b in body)


def _at(number: Parameter, values: Mapping[str, float]) -> Parameter:
    if number.name not in values:
        return number
    value = min(max(values[number.name], number.low), number.high)
    if number.amplitude:
        return replace(number, starts=(value if value != 0.0 else number.starts[0],))
    return replace(number, default=value, starts=(value,))


@dataclass(frozen=True)
class Discovery:
    """A discovered law, and the held-out error with and without it (else the fitted error).

    effect     its name, that of its file
    noise_m    of the measurement
    before_m, after_m   rms error without and with the law
    confirmed  on held-out trials; False if the study has none
    complete   whether the residual is noise
    source     Python of its file
    """

    effect: str
    parameters: Mapping[str, Interval]
    laws: tuple[str, ...]
    noise_m: float
    before_m: float
    after_m: float
    confirmed: bool
    complete: bool
    source: str

    @property
    def removed_share(self) -> float:
        """Share of the error beyond noise (mean square) that is gone, 0 … 1."""
        excess = self.before_m**2 - self.noise_m**2
        fall = self.before_m**2 - self.after_m**2
        return float(np.clip(fall / excess, 0.0, 1.0)) if excess > 0.0 else 1.0

    def write(self, path: Path) -> None:
        """Write the effect's file atomically."""
        write_atomic(path, self.source)

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-discovery/1",
            "effect": self.effect,
            "accepted": self.confirmed,
            "complete": self.complete,
            "laws": list(self.laws),
            "parameters": {name: vars(interval) for name, interval in self.parameters.items()},
            "noise_m": self.noise_m,
            "baseline_rms_m": self.before_m,
            "rms_m": self.after_m,
            "removed_share": self.removed_share,
        }


#: Rules that refit all terms, as there are few.
ALL_TERMS = Rules(max_refits=20)


class NothingFoundError(ValueError):
    """No law may be written.  Scenario: the model is complete already."""


def discover(fits: FitCache, out: Path) -> Discovery:
    """Find the missing law as an effect that is named after the file `out`.

    The residual is regressed on the marker changes by each admissible term (a score test with the
    cable's own parameters free), the best are refitted, and terms are added one after another under
    the same rules as known effects: significant, and confirmed on held-out trials.  The file is
    then loaded as a user's own effect and refitted.
    raises  NothingFoundError: the model is complete, or no term is accepted; ValueError: the file
            name is not allowed; nothing written
    """
    in_model = [e.name for e in fits.space.effects]
    name = effect_name(out, in_model)
    box_m = _box(fits.prepared.unjoined.role("fit"))
    terms = {t.effect: t for t in admissible(box_m) if t.effect not in in_model}
    with tempfile.TemporaryDirectory() as folder:
        single_terms = _each(terms.values(), Path(folder))
        with fits.work.stage("prepare"):
            search = FitCache.of(replace(fits.setup, library=single_terms, rules=ALL_TERMS))
        examination = diagnose(search)
    fits.work.renew()
    base, model = examination.fits.base, examination.accepted
    if model is base:
        study = fits.prepared.study.name
        raise NothingFoundError(f"study {study}: {_why_nothing(examination, base)}")
    accepted = [terms[e.name] for e in examination.fits.added(model)]
    about = f"Law inferred from the residuals of study {fits.prepared.study.name}."
    names = {f"{t.effect}.{n.name}": f"{name}.{n.name}" for t in accepted for n in t.numbers}
    source = effect_source(name, accepted, about, _values(model, names))
    with tempfile.TemporaryDirectory() as folder:
        effect = _loaded(Path(folder) / out.name, source)
        joined, final = with_joined(examination.fits, model, effect, names)
        estimate = Evidence(joined, final).estimate
    return Discovery(
        effect=name,
        source=source,
        parameters=estimate.intervals(effect),
        laws=tuple(t.law for t in accepted),
        noise_m=joined.prepared.noise_model.noise.std_m,
        before_m=_error(base),
        after_m=_error(final),
        confirmed=Independence.of(joined.prepared.study).held_out > 0,
        complete=examination.diagnosis.verdict != "unexplained",
    )


def _values(model: FittedModel, names: Mapping[str, str]) -> dict[str, float]:
    """Fitted values of the parameters with these names in the model, by the terms' own names."""
    space = model.fit.space
    natural = dict(zip(space.names, space.natural(model.fit.q).tolist(), strict=True))
    return {name.partition(".")[2]: natural[name] for name in names}


def effect_name(out: Path, known: Sequence[str] = ()) -> str:
    """Name of the effect in a file to be written.

    known   names of effects that the model has already
    raises  ValueError: it is no Python name, or taken
    """
    name = out.stem
    if out.suffix != ".py" or not name.isidentifier():
        raise ValueError(f"-o {out}: must be a file like law.py; the effect is named after it")
    if name in {*library(), *unscreened(), *known}:
        raise ValueError(f"-o {out}: there is an effect {name} already; give the file another name")
    return name


def _why_nothing(examination: Examination, base: FittedModel) -> str:
    """Error text: the reason for no law, and the remedy."""
    noise_m = examination.diagnosis.noise_m
    misses = f"it misses {_error(base) * 1e3:.4f} mm, noise is {noise_m * 1e3:.4f} mm"
    if examination.diagnosis.verdict == "complete":
        return (
            f"the model is complete ({misses}), use it as it is: there is no law to discover; "
            "nothing written"
        )
    nearest = min(examination.singles, key=_error, default=base)
    nearby = ""
    if nearest is not base:
        name = next(iter(nearest.names - base.names))
        nearby = f"; the nearest, {name}, would leave {_error(nearest) * 1e3:.4f} mm"
    if "interrupted" in examination.diagnosis.codes:
        return f"interrupted: no law is confirmed so far ({misses}){nearby}; nothing written"
    return (
        "no admissible law is significant and confirmed on held-out trials: the model is not "
        f"complete ({misses}){nearby}; nothing written. Measure more motions, or write an effect "
        "of your own (`cell help own_effect`)"
    )


def _error(candidate: FittedModel) -> float:
    return candidate.heldout.rms_m if candidate.heldout else candidate.fit.rms_m


def _loaded(path: Path, source: str) -> type[Effect]:
    path.write_text(source, encoding="utf-8")
    return load_effect(path, trusted=True)


@dataclass(frozen=True)
class Laws:
    """Admissible laws as effects, which `learn` tries in addition to the library.

    effects  by name, each in its own file
    written  files that are new
    """

    effects: dict[str, type[Effect]]
    written: tuple[Path, ...]

    def keep(self, used: Sequence[type[Effect]]) -> tuple[Path, ...]:
        """Remove the new files of unused effects; returns the files of the used laws."""
        used_files = tuple(
            e.file.path for e in used if e.file is not None and self.effects.get(e.name) is e
        )
        for path in set(self.written) - set(used_files):
            path.unlink()
        return used_files


def laws_in(folder: Path, studies: Sequence[Study], known: Sequence[type[Effect]] = ()) -> Laws:
    """Laws that no effect of the library has, as files in a folder; existing files are kept.

    folder   of their files; a model may refer to them
    studies  with the range of the cables' positions
    known    effects of the model: laws with their names are omitted
    raises   EffectError: a file there is no effect; ValueError: two effects have the same name
    """
    folder.mkdir(parents=True, exist_ok=True)
    old: dict[str, type[Effect]] = {}
    files = sorted(folder.glob("*.py"))
    for file in files:
        effect = load_effect(file)
        if effect.name in old:
            first = old[effect.name].file
            raise ValueError(
                f"{file}: is called {effect.name!r} as {first and first.path.name} is; rename one "
                "(`name = …` in its file)"
            )
        old[effect.name] = effect
    named = {e.name for e in known}
    # an old file has the term's name alone
    written = {*old, *(f"{NAMESPACE}{name}" for name in old), *(p.stem for p in files), *named}
    terms = admissible(_box([t for study in studies for t in study.trials]))
    new = _each([t for t in terms if t.effect not in written], folder)
    effects = {n: e for n, e in old.items() if n not in named} | new
    return Laws(effects, tuple(folder.resolve() / f"{n}.py" for n in new))


def _each(terms: Iterable[Term], folder: Path) -> dict[str, type[Effect]]:
    """Every term as an effect of its own, by name, from its file in the folder."""
    about = "A law that no effect of the library has."
    return {
        t.effect: _loaded(folder / f"{t.effect}.py", effect_source(t.effect, [t], about))
        for t in terms
    }


def _box(trials: Sequence[Trial]) -> tuple[float, float, float, float]:
    """Bounding box of the observed markers in trials: x low, x high, y low, y high, m."""
    points = np.concatenate([t.markers.xy_m.reshape(-1, 2) for t in trials])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])

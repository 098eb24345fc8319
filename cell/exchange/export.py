"""Export of a model to MuJoCo: what it contains, what it omits, and the error of its tip."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.cable.model import CableModel
from cell.exchange.chain import Chain, OmittedEffect, chain_of, expressible, physical, resting_bends
from cell.exchange.mjcf import mjcf
from cell.exchange.peer import (
    BAR_M,
    REFERENCE,
    PeerTrial,
    Reference,
    TipDifference,
    compare,
    difference,
    engine_tip,
    stroke,
)
from cell.files.table import TableData

#: Steps and numbers of links that are tried, the cheapest first.
STEPS_S = (1e-3, 5e-4, 2.5e-4, 1e-4)
LINKS = (14, 20, 28, 40, 56)
#: Share of the bar that the stroke may use: other motions may be worse.
SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Export:
    """A model as MuJoCo's XML, and the comparison with the project's engine.

    step_s       of MuJoCo's integrator
    differences  to the model with the effects that MuJoCo can express, motion by motion
    missing      to the complete model, because of omitted effects; empty if none is of the cable
    """

    xml: str
    chain: Chain
    step_s: float
    effects: tuple[str, ...]
    left_out: tuple[OmittedEffect, ...]
    differences: tuple[TipDifference, ...]
    missing: tuple[TipDifference, ...]

    @property
    def within_bar(self) -> bool:
        """Whether the tip stays within `BAR_M` in every motion."""
        return all(d.rms_m <= BAR_M for d in self.differences)

    def to_json(self) -> dict[str, Any]:
        """Plain data; lengths in m."""
        return {
            "format": "cable-export/1",
            "links": self.chain.links,
            "step_s": self.step_s,
            "effects": list(self.effects),
            "left_out": [vars(effect) for effect in self.left_out],
            "bar_rms_m": BAR_M,
            "within_bar": self.within_bar,
            "differences": [_plain(d) for d in self.differences],
            "missing": [_plain(d) for d in self.missing],
        }


def _plain(tip: TipDifference) -> dict[str, Any]:
    """Numbers that JSON can have: null where MuJoCo diverged."""
    return {n: None if v == np.inf else v for n, v in vars(tip).items()}


def export_to_mujoco(
    model: CableModel,
    origin: str,
    links: int | None = None,
    trials: Sequence[PeerTrial] = (),
) -> Export:
    """Export a model as MJCF, and compare it with the engine in the stroke and in these trials.

    origin  where the model is from, for the comment in the file
    links   None = the fewest that keep the stroke within `SHARE` of the bar
    raises  NoMujocoError; `simulate`'s errors; ValueError: fewer than 4 links
    """
    expressed, omitted = expressible(model)
    references = [Reference.of(expressed, trial) for trial in (stroke(), *trials)]
    chain, step_s, first = _cheapest(expressed, references[0], LINKS if links is None else (links,))
    differences = (first, *(compare(expressed, chain, step_s, r) for r in references[1:]))
    missing: list[TipDifference] = []
    complete = physical(model)
    if len(complete.effects) > len(expressed.effects):
        for r in references:
            tip = engine_tip(complete, r.trial, r.times_s)
            missing.append(difference(r.trial.name, tip, r.tip_m))
    names = tuple(active.effect.name for active in expressed.effects)
    notes = _notes(model, origin, chain, names, omitted, differences)
    xml = mjcf(chain, step_s, resting_bends(expressed, chain.links, 0.0), notes)
    return Export(xml, chain, step_s, names, omitted, differences, tuple(missing))


def sampled_xml(done: Export, models: Sequence[CableModel], origin: str) -> list[str]:
    """MJCF texts of sampled parameter sets, with the links and the time step of an export.

    raises  `simulate`'s errors
    """
    texts = []
    for number, model in enumerate(models, 1):
        expressed, _ = expressible(model)
        chain = chain_of(expressed, done.chain.links)
        notes = [f"Sample {number} of {len(models)} of the parameters of {origin}. SI units."]
        texts.append(mjcf(chain, done.step_s, resting_bends(expressed, chain.links, 0.0), notes))
    return texts


def _cheapest(
    model: CableModel, reference: Reference, links: Sequence[int]
) -> tuple[Chain, float, TipDifference]:
    """The first chain and step that keep the stroke within the share of the bar, else the best."""
    tried: list[tuple[Chain, float, TipDifference]] = []
    for step_s in STEPS_S:
        least = np.inf
        for number in links:
            chain = chain_of(model, number)
            tip_error = compare(model, chain, step_s, reference)
            tried.append((chain, step_s, tip_error))
            if tip_error.rms_m <= SHARE * BAR_M:
                return tried[-1]
            if tip_error.rms_m >= least or tip_error.rms_m == np.inf:
                break  # the remaining error is the step's, or shorter links diverge too
            least = tip_error.rms_m
    return min(tried, key=lambda one: one[2].rms_m)


def _notes(
    model: CableModel,
    origin: str,
    chain: Chain,
    effects: Sequence[str],
    omitted: Sequence[OmittedEffect],
    differences: Sequence[TipDifference],
) -> list[str]:
    """The comment at the head of the file."""
    notes = [
        f"A cable as {chain.links} hinges, exported from {origin}. SI units.",
        f"Exponent N {model.exponent:.4g}, viscosity {model.viscosity_n_m2_s:.4g} N·m²·s.",
        "World x is the cell's x, world z its y; the cable begins along −x.",
        "The controls are the gripper's acceleration: m/s², m/s², rad/s².",
        f"Effects in it: {', '.join(effects) or 'none'}.",
        *(f"Left out: {effect.name}: {effect.reason}." for effect in omitted),
    ]
    if chain.air_kg_per_m3:
        notes.append("option/density is the air's times the drag coefficient, for all bodies.")
    reference = f"{REFERENCE.segments} segments, {REFERENCE.step_s * 1e3:g} ms"
    for effect in differences:
        apart = f"{effect.rms_m * 1e3:.3f} mm rms, {effect.most_m * 1e3:.3f} mm at most"
        far = "it diverges" if effect.rms_m == np.inf else apart
        notes.append(
            f"Tip in {effect.name!r}: {far}, from the engine it was identified with ({reference})."
        )
    return notes


def export_parts(done: Export) -> Iterator[TableData | str]:
    """Printed parts of an export: its content, its omissions, distances of the tips, mm."""
    yield f"chain: {done.chain.links} links, steps of {done.step_s * 1e3:g} ms"
    yield f"effects in it: {', '.join(done.effects) or 'none'}"
    for effect in done.left_out:
        yield f"left out: {effect.name}: {effect.reason}"
    yield difference_table(done)
    if not done.within_bar:
        yield (
            f"The tip differs by more than {BAR_M * 1e3:g} mm rms: give more --links, or check the "
            "model."
        )


def difference_table(done: Export) -> TableData:
    """Table of the tips' distances by motion, mm, and of those by omitted effects."""
    heads = ["motion", "rms", "at most", *(["rms of what is left out"] if done.missing else [])]
    rows = []
    for i, tip in enumerate(done.differences):
        rows.append([tip.name, _mm(tip.rms_m), _mm(tip.most_m)])
        if done.missing:
            rows[-1].append(_mm(done.missing[i].rms_m))
    title = "Tip in MuJoCo, from the engine, mm"
    return TableData(title, heads, rows, numbers=range(1, len(heads)))


def _mm(length_m: float) -> str:
    return "diverges" if length_m == np.inf else f"{length_m * 1e3:.3f}"

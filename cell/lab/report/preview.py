"""What `cell import` shows before it writes a study: trials as proposed, what was understood."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.files.input_error import InputError
from cell.files.yaml_document import Document
from cell.lab.report.look_page import StudyOverview
from cell.study.facts import facts_of, oddities
from cell.study.imports.capture import Finding, Sure
from cell.study.imports.convert import study_of, trials_of
from cell.study.imports.mapping import ReadMapping
from cell.study.imports.quality import slips
from cell.study.imports.trials import Files
from cell.study.imports.understand import Understanding

_HEADS = {
    Sure.WANTED: "To be filled in:",
    Sure.GUESSED: "Guesses, to be checked:",
    Sure.SEEN: "The data show:",
    Sure.SAID: "The file states:",
}


def preview_of(
    files: Sequence[Files], understood: Understanding, mapping_file: Path
) -> StudyOverview:
    """Trials as they would be, what is odd, and what the study would be refused for.

    mapping_file  where the mapping will be, for complaints about it
    """
    read = ReadMapping(understood.mapping, Document(mapping_file, {}, {(): (1, 1)}))
    captures = {f.file: f.capture for f in files}
    captures |= {
        f.gripper_file: f.gripper for f in files if f.gripper_file and f.gripper is not None
    }
    trials, problems = trials_of(read, captures)
    notes = [note for capture in captures.values() for note in capture.notes]
    if not problems and not any(f.sure is Sure.WANTED for f in understood.findings):
        try:
            imported = study_of(read, captures)
            notes = [*imported.notes, *slips(imported.study)]
            trials = list(imported.study.trials)
        except InputError as error:
            problems = list(error.problems)
    arcs = [m.arc_length_m for m in read.mapping.markers]
    tip_first = np.array([np.nan if a is None else a for a in arcs[::-1]], dtype=np.float64)
    facts = facts_of(trials, tip_first, read.mapping.gravity_m_per_s2)
    odd = [*notes, *oddities(facts, read.mapping.noise_std_m)]
    wrong = [str(p) for p in problems]
    title = f"Preview of {read.mapping.name}: nothing is written yet"
    return StudyOverview(
        read.mapping.name, title, trials, facts, _in_groups(understood.findings), wrong, odd
    )


def _in_groups(findings: Sequence[Finding]) -> dict[str, list[str]]:
    """What was understood, by how sure it is."""
    groups = {
        head: [f.sentence for f in findings if f.sure is sure] for sure, head in _HEADS.items()
    }
    return {head: found for head, found in groups.items() if found}

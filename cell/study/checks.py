"""All checks of a study's data: question, statistic, limit, remedy.

`cell look`, the preview of `cell import`, every command that reads a study, and the reference in
docs print them.
"""

from __future__ import annotations

from typing import Any

from cell.study.check import DataCheck
from cell.study.import_checks import IMPORT_NOTES, IMPORT_REFUSALS, IMPORT_SHAPE
from cell.study.record_checks import RECORD_NOTES, STUDY_NOTES
from cell.study.trial_checks import TRIAL_NOTES, TRIAL_REFUSALS
from cell.study.wrench import FORCE_NOTES

_GROUPS: tuple[tuple[DataCheck[Any], ...], ...] = (
    *(IMPORT_REFUSALS, IMPORT_SHAPE, TRIAL_REFUSALS, TRIAL_NOTES, IMPORT_NOTES),
    *(FORCE_NOTES, RECORD_NOTES, STUDY_NOTES),
)
#: All checks, without duplicates.
CHECKS = tuple({check.name: check for group in _GROUPS for check in group}.values())

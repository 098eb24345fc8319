"""Errors of a calibration, each with its cause and its remedy."""

from __future__ import annotations


class CalibrationError(ValueError):
    """Measurements cannot give a calibration that deserves the name: why, and the remedy.

    Scenario: any of the below; catch this one to refuse a calibration whatever the reason.
    """

    def __init__(self, cause: str, remedy: str) -> None:
        super().__init__(f"{cause}; {remedy}")
        self.cause = cause
        self.remedy = remedy


class TooFewError(CalibrationError):
    """Not enough was detected.  Scenario: three pictures; the marks hidden in most of them."""


class OneSidedError(CalibrationError):
    """Views or poses are too alike.  Scenario: a board never tilted; robot poses on a line."""


class BlurredError(CalibrationError):
    """Pictures are not sharp.  Scenario: board waved by hand; robot moved during exposure."""


class WrongBoardError(CalibrationError):
    """The board is not the one described.  Scenario: another size or dictionary; mirrored."""


class WrongScaleError(CalibrationError):
    """Lengths contradict each other.  Scenario: a board printed "to fit the page"."""


class MisfitError(CalibrationError):
    """Measurements contradict the model.  Scenario: a bent plate; a camera moved meanwhile."""

"""A signal that falls where Python drops what is raised still interrupts, at the next step."""

from __future__ import annotations

import contextlib
import os
import signal

import pytest

from cell.cli.shared import interrupted_once


def test_a_swallowed_interruption_is_raised_again() -> None:
    with interrupted_once() as not_lost:
        not_lost()
        # as the interpreter does in a callback or a destructor
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            not_lost()

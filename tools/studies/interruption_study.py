"""Interrupts a diagnosis at random moments, and checks what it prints and how it ends.

    python -m tools.studies.interruption_study STUDY [--moments 50] [--seed 1]

Each time `cell diagnose STUDY` runs until a moment between 0 and its usual duration.  Then SIGINT
or SIGTERM goes to the command, or SIGTERM to its whole group, as `timeout` does.  A line for each:
the moment, the signal, the exit code, seconds until the end, and what was said.  Ends with 1 if a
command did not say what it knew, or ended with another code.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: Until the program itself is loaded a command only says that it was interrupted, s of CPU time.
STARTING_S = 4.0


def run(study: Path, out: Path, after_s: float, how: str) -> tuple[int, float, str, str]:
    """Run and interrupt a diagnosis: exit code, s from signal to end, output and error stream."""
    command = [sys.executable, "-m", "cell", "diagnose", str(study), "-o", str(out), "--force"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            number = signal.SIGINT if how == "SIGINT" else signal.SIGTERM
            process.send_signal(number)
            if how == "group":
                os.killpg(process.pid, number)
        began_s = time.monotonic()
        said, errors = process.communicate()
        return process.returncode, time.monotonic() - began_s, said, errors


def outcome(
    code: int, how: str, out: Path, said: str, errors: str, cpu_s: float
) -> tuple[bool, str]:
    """Whether an interrupted command ended as it should, and what it printed."""
    right = 128 + (signal.SIGINT if how == "SIGINT" else signal.SIGTERM)
    if code == 0 and "Verdict " in said:
        return True, "had ended before"
    if out.exists():
        verdict = json.loads(out.read_text(encoding="utf-8"))["verdict"]
        return code == right and f"Verdict {verdict}" in said, f"verdict {verdict}"
    starting = cpu_s < STARTING_S and set(errors.split()) == {"interrupted"}
    known = "there are no results yet" in errors or starting
    return code == right and known and "Traceback" not in errors, errors.strip()[-120:]


def children_cpu_s() -> float:
    """CPU time of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--moments", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    draw, failed = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        began_s = time.monotonic()
        run(given.study, out, 1e4, "SIGTERM")
        whole_s = time.monotonic() - began_s
        for number in range(given.moments):
            out.unlink(missing_ok=True)
            after_s, before_s = draw.uniform(0.0, whole_s), children_cpu_s()
            how = ("SIGINT", "SIGTERM", "group")[number % 3]
            code, took_s, said, errors = run(given.study, out, after_s, how)
            good, words = outcome(code, how, out, said, errors, children_cpu_s() - before_s)
            failed += not good
            mark = "" if good else "WRONG "
            print(
                f"{mark}{after_s:.2f} s of {whole_s:.1f} s, {how}: code {code} {took_s:.1f} s "
                f"later; {words}",
                flush=True,
            )
    print(f"{given.moments - failed} of {given.moments} said what they knew")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

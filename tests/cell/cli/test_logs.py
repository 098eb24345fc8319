"""The log: one file that rotates, said once if it cannot be written, silent unless asked for."""

import logging
from pathlib import Path

import pytest

from cell.cli import logs


@pytest.fixture(autouse=True)
def without_handlers():
    yield
    for name in logs.PACKAGES:
        for handler in list(logging.getLogger(name).handlers):
            logging.getLogger(name).removeHandler(handler)
            handler.close()


def test_messages_of_all_packages_are_in_the_file_with_time_and_name(tmp_path: Path) -> None:
    path = tmp_path / "new" / "line3.log"
    logs.to_file(path)
    logging.getLogger("drivers.ur").warning("connection lost")
    logging.getLogger("cell.run.cycle").info("cycle 3: step grasp")
    first, second, third = path.read_text().splitlines()
    assert "cell 0." in first and "Python 3." in first
    assert second.endswith("WARNING drivers.ur: connection lost")
    assert third.endswith("INFO    cell.run.cycle: cycle 3: step grasp")
    logs.to_file(tmp_path / "other.log")  # a further run in one process: not in both files
    logging.getLogger("cell.x").info("later")
    assert "later" not in path.read_text()


def test_files_rotate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "FILE_BYTES", 500)
    logs.to_file(tmp_path / "cell.log")
    for i in range(100):
        logging.getLogger("cell").info("message %d", i)
    files = sorted(tmp_path.iterdir())
    assert len(files) == 1 + logs.OLD_FILES
    assert all(f.stat().st_size <= 500 for f in files)


def test_a_log_that_cannot_be_written_is_said_once_and_stops_nothing(
    tmp_path: Path, capsys
) -> None:
    (tmp_path / "file").write_text("")
    logs.to_file(tmp_path / "file" / "cell.log")
    logging.getLogger("cell").info("more")
    assert capsys.readouterr().err.count("the log cannot be written") == 1


def test_a_program_that_nobody_looks_at_prints_warnings_once(capsys) -> None:
    for verbose in (False, True):
        logs.to_terminal(verbose=verbose)
        logs.warnings_to_terminal()
        logging.getLogger("cell.plant").info("a client came")
        logging.getLogger("cell.plant").warning("the cell is away")
        said = capsys.readouterr().err
        assert said.count("the cell is away") == 1
        assert ("a client came" in said) is verbose


def test_only_verbose_prints(capsys) -> None:
    logs.to_terminal(verbose=False)
    logging.getLogger("cell").warning("unheard")
    logs.to_terminal(verbose=True)
    logging.getLogger("cell").debug("heard")
    err = capsys.readouterr().err
    assert "unheard" not in err and err.count("heard") == 1

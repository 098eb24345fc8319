"""A settings file is replaced whole; the former one is kept, and another's change is not lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.settings.versions import ChangedMeanwhileError, replace_settings, versions


def test_the_former_file_is_kept(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    config.write_bytes(b"a: 1\r\n")
    link = tmp_path / "link.yaml"
    link.symlink_to(config)
    assert replace_settings(link, "a: 1\r\n", "a: 2\n").read_bytes() == b"a: 1\r\n"
    replace_settings(config, "a: 2\n", "a: 3\n")
    assert link.is_symlink() and config.read_text("utf-8") == "a: 3\n"
    assert [p.read_bytes() for p in versions(link)] == [b"a: 2\n", b"a: 1\r\n"]


def test_a_file_that_was_changed_meanwhile_stays(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    config.write_text("a: 7\n", "utf-8")
    with pytest.raises(ChangedMeanwhileError) as refused:
        replace_settings(config, "a: 1\n", "a: 2\n")
    assert refused.value.text == config.read_text("utf-8") == "a: 7\n"
    assert versions(config) == ()

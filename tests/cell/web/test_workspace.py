"""What is uploaded to the lab: studies and tables are kept, attacks are refused with a remedy."""

from __future__ import annotations

import io
import os
import time
import zipfile
from pathlib import Path, PurePosixPath

import pytest

from cell.study.imports.read import KINDS
from cell.web import workspace
from cell.web.workspace import UploadError, Workspace, is_name, placed, plain

STUDY = {"my study/study.yaml": b"format: x", "my study/swing/markers.csv": b"t_s"}


@pytest.fixture
def lab(tmp_path: Path) -> Workspace:
    return Workspace.of_runs(tmp_path / "runs")


def archive(files: dict[str, bytes], *, links: tuple[str, ...] = ()) -> io.BytesIO:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            if name in links:
                entry.external_attr = 0o120777 << 16
            made.writestr(entry, content)
    file.seek(0)
    return file


def loose(files: dict[str, bytes]) -> list[tuple[str, io.BytesIO]]:
    return [(name, io.BytesIO(content)) for name, content in files.items()]


def left_over(lab: Workspace) -> list[str]:
    return sorted(p.name for p in lab.folder.rglob("*")) if lab.folder.exists() else []


def test_a_study_is_kept_as_a_folder_or_an_archive(lab: Workspace) -> None:
    litter = {"__MACOSX/._study.yaml": b"", "my study/.DS_Store": b""}
    first = lab.take(loose({**STUDY, **litter}))
    second = lab.take([("my study.zip", archive({**STUDY, **litter}))])
    assert (first.name, second.name) == ("my_study", "my_study-2")
    assert first.is_study and second.is_study
    for name in (first.name, second.name):
        assert (lab.studies / name / "swing" / "markers.csv").read_bytes() == b"t_s"
    assert not [name for name in left_over(lab) if name.startswith(".")]
    flat = lab.take([("flat.zip", archive({"study.yaml": b"", "a/markers.csv": b""}))])
    assert (flat.name, flat.is_study) == ("flat", True)


def test_tables_are_kept_for_the_import(lab: Workspace) -> None:
    taken = lab.take(loose({"day 1/a.csv": b"1", "day 1/b.trc": b"2"}))
    assert (taken.name, taken.is_study, taken.files) == ("day_1", False, ("a.csv", "b.trc"))
    assert (lab.uploads / "day_1" / "b.trc").read_bytes() == b"2"
    assert lab.uploaded("day_1") == ["a.csv", "b.trc"]
    assert lab.uploaded("../uploads/day_1") == lab.uploaded("none") == []


def test_every_kind_of_file_that_an_import_reads_is_taken(lab: Workspace) -> None:
    files = {f"a{kind}": b"1" for kind in KINDS}
    assert set(lab.take(loose(files)).files) == set(files)


@pytest.mark.parametrize(
    "name", ["../a.csv", "/etc/a.csv", "a/../../b.csv", "..\\a.csv", "C:\\a.csv", "a\0.csv"]
)
def test_no_name_leads_out_of_the_folder(lab: Workspace, name: str) -> None:
    with pytest.raises(UploadError, match="leads out"):
        lab.take(loose({name: b"1"}))
    with pytest.raises(UploadError, match=r"leads out|cannot be read|not taken"):
        lab.take([("a.zip", archive({name: b"1"}))])
    assert left_over(lab) == []


def test_names_become_plain() -> None:
    script = "<img src=x onerror=alert(1)>.csv"
    assert placed(script) == PurePosixPath("img_src_x_onerror_alert_1.csv")
    assert plain("") == "" and plain("…") == "" and plain("?.csv") == "file.csv"
    assert is_name("a-b_1.2") and not is_name("-a") and not is_name("a/b") and not is_name("a.")
    assert not is_name("a" * 200)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"law.py": b""}, "'law.py': files of this kind are not taken"),
        ({"a/b/c/d/e.csv": b""}, "5 folders deep"),
        ({"a?.csv": b"", "a!.csv": b""}, "two files have this name"),
        ({"a/x.csv": b"", "b/x.csv": b""}, "same name"),
        ({"a/study.yaml": b"", "b/study.yaml": b""}, "2 studies at once"),
        ({"a.zip": b"", "b.zip": b""}, "one archive"),
        ({".hidden.csv": b""}, "no file"),
        ({"a.zip": b"PK no archive"}, "cannot be read"),
        ({"…/b.csv": b""}, "no name of a file"),
        ({"b.csv": b"", "b.csv/c.csv": b""}, "two files have this name"),
    ],
)
def test_what_is_not_taken_is_named(lab: Workspace, files: dict[str, bytes], said: str) -> None:
    with pytest.raises(UploadError, match=said):
        lab.take(loose(files))
    assert left_over(lab) == []


def test_an_archive_unpacks_to_no_more_than_is_allowed(
    lab: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workspace, "MOST_UNPACKED", 1 << 20)
    bomb = archive({"a.csv": bytes(900_000), "b.csv": bytes(900_000)})
    assert len(bomb.getvalue()) < 10_000
    with pytest.raises(UploadError, match=r"b\.csv: with it the upload has over 1 MiB"):
        lab.take([("bomb.zip", bomb)])
    with pytest.raises(UploadError, match="over 1 MiB"):
        lab.take(loose({"a.csv": bytes((1 << 20) + 1)}))
    monkeypatch.setattr(workspace, "MOST_FILES", 3)
    with pytest.raises(UploadError, match="has 4 files; at most 3"):
        lab.take([("many.zip", archive({f"{n}.csv": b"" for n in range(4)}))])
    assert left_over(lab) == []


def test_an_archive_holds_no_links(lab: Workspace) -> None:
    with pytest.raises(UploadError, match="is a link"):
        lab.take([("a.zip", archive({"a.csv": b"/etc/passwd"}, links=("a.csv",)))])


def test_a_damaged_archive_is_refused(lab: Workspace) -> None:
    content = bytearray(archive({"a.csv": bytes(range(256)) * 50}).getvalue())
    content[60:80] = bytes(20)
    with pytest.raises(UploadError, match="make it anew"):
        lab.take([("a.zip", io.BytesIO(bytes(content)))])


def test_what_is_old_or_too_much_goes(lab: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    ages_days = {"old": 40, "older": 41, "new": 1, "newest": 0}
    for name, days in ages_days.items():
        lab.take(loose({f"{name}/a.csv": bytes(1000)}))
        at = time.time() - days * 86400
        for path in (lab.uploads / name / "a.csv", lab.uploads / name):
            os.utime(path, (at, at))
    (lab.effects / "kept.py").parent.mkdir()
    (lab.effects / "kept.py").write_text("x")
    assert lab.tidy({"older"}) == ["old"]
    monkeypatch.setattr(workspace, "MOST_BYTES", 2500)
    assert lab.tidy({"older"}) == ["new"]
    assert lab.names(lab.uploads) == ["newest", "older"]
    assert lab.names(lab.effects, ".py") == ["kept"]


def test_only_paths_inside_are_inside(lab: Workspace, tmp_path: Path) -> None:
    lab.take(loose({"a/a.csv": b""}))
    assert lab.inside(lab.studies / ".." / "uploads" / "a" / "a.csv")
    assert not lab.inside(lab.studies / ".." / ".." / "x.csv")
    (lab.uploads / "a" / "link.csv").symlink_to("/etc/passwd")
    assert not lab.inside(lab.uploads / "a" / "link.csv")

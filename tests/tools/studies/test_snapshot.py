"""Commands whose answers are kept: each can be typed as it stands."""

from pathlib import Path

from tools.studies.snapshot import commands, compare


def test_studies_are_diagnosed_and_cycles_learned_from_with_their_settings(tmp_path: Path) -> None:
    study = tmp_path / "studies" / "one"
    study.mkdir(parents=True)
    (study / "study.yaml").touch()
    for name in ("b", "a"):
        (tmp_path / "runs_mass" / name).mkdir(parents=True)
        (tmp_path / "runs_mass" / name / "settings.yaml").touch()
    (tmp_path / "runs_mass" / "run.log").touch()
    runs = tmp_path / "runs_mass"
    assert commands([tmp_path / "studies", runs]) == {
        "diagnose_one": ["diagnose", str(study)],
        "fit_one": ["fit", str(study)],
        "learn_runs_mass": [
            "learn", str(runs / "a"), str(runs / "b"), "-c", str(runs / "a" / "settings.yaml"),
        ],
    }  # fmt: skip


def test_files_that_differ_or_are_missing_are_counted(tmp_path: Path) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    for folder in (before, after):
        folder.mkdir()
        (folder / "same").write_text("1", encoding="utf-8")
    (before / "changed").write_text("1", encoding="utf-8")
    (after / "changed").write_text("1.0", encoding="utf-8")
    (after / "new").touch()
    assert compare(before, after) == 2

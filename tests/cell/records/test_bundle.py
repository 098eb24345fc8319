"""A bundle holds what is needed, and no secret."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.files.yaml_document import yaml_text
from cell.records.bundle import Item, items_of_cycle, items_of_log, without_secrets, write_bundle
from cell.records.recording import form
from cell.settings import load_settings
from cell.settings.plant import Mqtt, Plant
from cell.settings.records import LedgerSettings


def written(items, path):
    done = write_bundle(list(items), path, lambda name, number, total: None)
    with zipfile.ZipFile(path) as bundle:
        assert bundle.testzip() is None
        contents = {name: bundle.read(name) for name in bundle.namelist()}
    return done, contents, json.loads(contents.pop("manifest.json"))


@pytest.fixture
def cycle(tmp_path: Path) -> Path:
    folder = tmp_path / "runs" / "20261124T101500.000-1"
    (folder / "study").mkdir(parents=True)
    (folder / "study" / "study.yaml").write_text("format: cable-study/1\n")
    (folder / "settings.yaml").write_text("camera: {kind: opencv, device: 0}\n")
    (folder / form.FILE).write_bytes(os.urandom(3 * 2**20))
    return folder


def test_a_full_disk_is_said_of_the_bundle(tmp_path, full_disk):
    bundle = tmp_path / "bundle.zip"
    items = [Item("log/x.log", os.urandom(20_000).hex())]
    with pytest.raises(OSError, match="File too large") as failed:
        write_bundle(items, bundle, lambda name, number, total: None)
    assert failed.value.filename == str(bundle)


def test_everything_is_in_it_and_the_manifest_proves_it(tmp_path, cycle):
    (tmp_path / "runs.log").write_text("line 1\n")
    (tmp_path / "runs.log.1").write_text("line 0\n")
    items = [*items_of_log(tmp_path / "runs.log"), *items_of_cycle(cycle, recordings=True)]
    items.append(Item("versions.txt", "cell 1"))
    done, contents, manifest = written(items, tmp_path / "bundle.zip")
    assert contents[f"cycles/{cycle.name}/{form.FILE}"] == (cycle / form.FILE).read_bytes()
    assert contents["log/runs.log.1"] == b"line 0\n"
    assert set(contents) == {i.name for i in items} == set(done.files)
    for file in manifest["files"]:
        content = contents[file["name"]]
        assert file["bytes"] == len(content)
        assert file["sha256"] == hashlib.sha256(content).hexdigest()
    assert not manifest["left_out"] and not manifest["secrets_removed_from"]


def test_frames_are_left_out_if_that_is_wanted(tmp_path, cycle):
    _, contents, _ = written(items_of_cycle(cycle, recordings=False), tmp_path / "bundle.zip")
    assert not any(name.endswith(".mcap") for name in contents)
    assert len(contents) == 2


def test_a_secret_is_in_no_file(tmp_path, cycle):
    (cycle / "settings.yaml").write_text("camera: {device: 'rtsp://ada:s3cret@10.0.0.7/1'}\n")
    (tmp_path / "runs.log").write_text("INFO cell: PGPASSWORD=s3cret was set; token: 'ab s3cret'\n")
    items = [*items_of_cycle(cycle, recordings=True), *items_of_log(tmp_path / "runs.log")]
    done, contents, manifest = written(items, tmp_path / "bundle.zip")
    assert not any(b"s3cret" in content for content in contents.values())
    assert b"rtsp://(removed)@10.0.0.7/1" in contents[f"cycles/{cycle.name}/settings.yaml"]
    recording = f"cycles/{cycle.name}/{form.FILE}"
    assert done.left_out == manifest["left_out"] == {recording: "its settings hold a secret"}
    assert set(done.cleaned) == {f"cycles/{cycle.name}/settings.yaml", "log/runs.log"}


@given(
    st.text("abcdefXYZ0123456789-._~!$&*+,;=%", min_size=1, max_size=20),
    st.sampled_from(["rtsp", "postgresql+psycopg", "s3", "https"]),
)
def test_no_password_of_a_url_is_left(password, scheme):
    cleaned = without_secrets(f"url: {scheme}://ada:{password}@host:5432/x # comment")
    assert cleaned == f"url: {scheme}://(removed)@host:5432/x # comment"


def test_what_is_no_secret_stays():
    text = "promotion: {withdraw: true}\nurl: postgresql://plant/cables\nkeys: 3\nby: a@b.c\n"
    text += "url: postgresql://cell@plant/cables\n"
    assert without_secrets(text) == text


@pytest.mark.parametrize("given", [{}, {"user": "cell", "password_file": "/etc/cell/broker"}])
def test_settings_without_a_secret_cost_no_recording(tmp_path, cycle, given):
    """As a cycle keeps them: with every key, and null where nothing is given."""
    tls = {"tls": {}} if given else {}
    settings = load_settings(Path("config/fake.yaml"))
    mqtt = Mqtt.model_validate({"broker": "127.0.0.1", "group": "plant", **tls, **given})
    settings = settings.model_copy(update={"plant": Plant(mqtt=mqtt), "ledger": LedgerSettings()})
    (cycle / "settings.yaml").write_text(yaml_text(settings.model_dump(mode="json")))
    done, _, _ = written(items_of_cycle(cycle, recordings=True), tmp_path / "bundle.zip")
    assert not done.left_out and not done.cleaned


def test_what_cannot_be_read_is_named(tmp_path, cycle):
    items = [Item("log/gone.log", tmp_path / "gone.log"), Item("gone.png", tmp_path / "gone.png")]
    done, contents, _ = written([*items, Item("versions.txt", "1")], tmp_path / "bundle.zip")
    assert set(done.left_out) == {"log/gone.log", "gone.png"}
    assert set(contents) == {"versions.txt"}


def test_a_full_disk_leaves_no_half_bundle(tmp_path, cycle, monkeypatch):
    (tmp_path / "bundle.zip").write_text("the one before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cell.records.bundle._add", full)
    with pytest.raises(OSError, match="No space"):
        written(items_of_cycle(cycle, recordings=True), tmp_path / "bundle.zip")
    assert (tmp_path / "bundle.zip").read_text() == "the one before"
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        (
            "ledger: {url: postgresql://cell:s3/cret@db/plant}",
            "ledger: {url: postgresql://(removed)@db/plant}",
        ),
        ("url: mqtt://cell:s3@cret@broker:1883", "url: mqtt://(removed)@broker:1883"),
        ("tokens: 'null and void'", "tokens: (removed)"),
        ("password: nullable", "password: (removed)"),
        ("password: s3,cret", "password: (removed)"),
        ('{"password": "s3\\"cret", "port": 1}', '{"password": (removed), "port": 1}'),
        ("broker: {password: s3cret, port: 1}", "broker: {password: (removed), port: 1}"),
    ],
)
def test_no_part_of_a_password_is_left(text, clean):
    assert without_secrets(text) == clean

"""One file for the maker after a failure: log, settings, versions, cycles, ledger."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path

from cell.files.rescue import naming
from cell.records.recording import form

#: Replacement for user name and password in a URL, or for a value that is named as a secret.
REMOVED = "(removed)"
#: A database's user without a password is not removed.
_IN_URL = re.compile(r"(?<=://)(?!(?<=postgresql://)[^\s'\":@]+@)[^\s'\"]+@")
_SAID = re.compile(
    r"(?im)(?P<name>\b[\w-]*(?:password|passwd|secret|token|api_?key)[\w-]*(?<!_file)['\"]?\s*[:=]\s*)"
    r"(?!(?:null|None|~|''|\"\")\s*(?:[,}\]#]|$))"
    r"(?P<value>\"(?:\\.|[^\"\\\n])*\"|'[^'\n]*'|(?:,(?!\s|$)|[^\s,}{])+)"
)
#: Suffixes of text files, from which secrets are removed; other files are copied as they are.
_TEXT = frozenset({".csv", ".json", ".log", ".md", ".py", ".txt", ".yaml", ".yml", ""})
#: Suffixes of compressed files.
_PACKED = frozenset({".mcap", ".jpg", ".png", ".gz", ".zip"})
_BLOCK_BYTES = 2**20


@dataclass(frozen=True)
class Item:
    """A file of a bundle.

    name     in the bundle
    content  a file, or text
    """

    name: str
    content: Path | str


@dataclass(frozen=True)
class Bundled:
    """Content of a bundle that `write_bundle` has written.

    files     name → bytes
    left_out  name → why
    cleaned   files from which a secret was removed
    """

    files: Mapping[str, int]
    left_out: Mapping[str, str]
    cleaned: Sequence[str]


def without_secrets(text: str) -> str:
    """The text without users and passwords of URLs, and without values that are named as secrets.

    Names of files and null are no secrets.
    """
    text = _IN_URL.sub(f"{REMOVED}@", text)
    return _SAID.sub(lambda m: m["name"] + REMOVED, text)


def packages() -> str:
    """Installed packages, name==version, one a line."""
    lines = {f"{d.metadata['Name']}=={d.version}" for d in distributions()}
    return "\n".join(sorted(lines, key=str.lower)) + "\n"


def items_of_cycle(folder: Path, *, recordings: bool) -> Iterator[Item]:
    """All files of a cycle's folder; without its frames if `recordings` is False."""
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        if recordings or file.name not in form.WITH_FRAMES:
            yield Item(f"cycles/{folder.name}/{file.relative_to(folder)}", file)


def items_of_log(log: Path) -> Iterator[Item]:
    """A log, and the older ones into which it was rotated."""
    for file in sorted(log.parent.glob(f"{log.name}*")):
        if file.is_file():
            yield Item(f"log/{file.name}", file)


def write_bundle(
    items: Sequence[Item], path: Path, progress: Callable[[str, int, int], None]
) -> Bundled:
    """Write a ZIP file atomically, with a manifest of every file's size and SHA-256.

    A recording is left out if a secret was removed from its settings: it holds them too.

    progress  callback: name, number of files written, number of all files
    raises    OSError: the bundle cannot be written; unreadable files are skipped
    """
    files: dict[str, int] = {}
    hashes: dict[str, str] = {}
    left_out: dict[str, str] = {}
    cleaned: list[str] = []
    part = path.with_name(f"{path.name}.part")
    try:
        with naming(path), zipfile.ZipFile(part, "w", allowZip64=True) as bundle:
            # settings first: they show whether the recordings of their folder hold secrets
            for number, item in enumerate(sorted(items, key=_is_recording)):
                progress(item.name, number, len(items))
                folder = item.name.rpartition("/")[0]
                if _is_recording(item) and f"{folder}/settings.yaml" in cleaned:
                    left_out[item.name] = "its settings hold a secret"
                    continue
                try:
                    content, clean = _content(item)
                except OSError as error:
                    left_out[item.name] = error.strerror or str(error)
                    continue
                if clean:
                    cleaned.append(item.name)
                try:
                    files[item.name], hashes[item.name] = _add(bundle, item.name, content)
                except _UnreadableError as error:
                    left_out[item.name] = str(error)
            manifest = {
                "format": "cable-bundle/1",
                "files": [
                    {"name": name, "bytes": size, "sha256": hashes[name]}
                    for name, size in files.items()
                ],
                "left_out": left_out,
                "secrets_removed_from": cleaned,
            }
            bundle.writestr("manifest.json", json.dumps(manifest, indent=2, ensure_ascii=False))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return Bundled(files, left_out, cleaned)


class _UnreadableError(Exception):
    """A file that goes into a bundle cannot be read to its end."""


def _is_recording(item: Item) -> bool:
    return isinstance(item.content, Path) and item.content.name in form.WITH_FRAMES


def _content(item: Item) -> tuple[Path | bytes, bool]:
    """A file to copy unchanged, or cleaned text; and whether a secret was removed."""
    if isinstance(item.content, str):
        return item.content.encode(), False
    if item.content.suffix not in _TEXT and ".log." not in item.content.name:
        return item.content, False
    raw = item.content.read_bytes()
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        return item.content, False
    clean = without_secrets(text)
    return clean.encode(), clean != text


def _add(bundle: zipfile.ZipFile, name: str, content: Path | bytes) -> tuple[int, str]:
    """Add a file; its size and SHA-256."""
    if isinstance(content, bytes):
        bundle.writestr(name, content, zipfile.ZIP_DEFLATED)
        return len(content), hashlib.sha256(content).hexdigest()
    try:
        info = zipfile.ZipInfo.from_file(content, name, strict_timestamps=False)
        source = content.open("rb")
    except OSError as error:
        raise _UnreadableError(error.strerror or str(error)) from error
    packed = content.suffix in _PACKED
    info.compress_type = zipfile.ZIP_STORED if packed else zipfile.ZIP_DEFLATED
    digest, size = hashlib.sha256(), 0
    with source, bundle.open(info, "w", force_zip64=True) as sink:
        while block := source.read(_BLOCK_BYTES):
            digest.update(block)
            size += len(block)
            sink.write(block)
    return size, digest.hexdigest()

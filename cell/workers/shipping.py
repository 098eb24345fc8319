"""Packs jobs and results as bytes; effects of a user's files are sent as their source.

A worker loads an effect from its source, checked by its hash; a result refers to the class of this
process.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cell.cable.effects import Effect, load_effect
from cell.cable.effects.remote import confine_effects, is_remote
from cell.files.words import error_text
from cell.identify.model_class import ModelClass
from cell.workers.executor import JobResult, WorkersError

#: Path at the client, hash, source, and whether it is confined.
_Source = tuple[str, str, bytes, bool]
#: Folder of received sources; it is removed at the end of the process.
_folder: tempfile.TemporaryDirectory[str] | None = None
#: Classes of users' effects by path at the client and hash; and the sources to send, by class.
_classes: dict[tuple[str, str], type[Effect]] = {}
_sources: dict[type[Effect], _Source] = {}


def pack(content: object) -> bytes:
    """The content as bytes that `unpack` reads in this or another process.

    raises  WorkersError: it cannot be pickled, or the file of an effect was changed meanwhile
    """
    packed = io.BytesIO()
    try:
        _Packer(packed, pickle.HIGHEST_PROTOCOL).dump(content)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise WorkersError(f"cannot be sent to a worker: {error}") from error
    return packed.getvalue()


def unpack(packed: bytes) -> Any:
    """The content that was packed.

    raises  WorkersError: an effect's source is damaged; EffectError
    """
    return pickle.loads(packed)


def know_own_effects() -> None:
    """Remember the sources of loaded effects of users' files, so that forks can pack them."""
    for effect in _all_of(Effect):
        if effect.file is not None and effect not in _sources:
            try:
                _source_of(effect)
            except (OSError, WorkersError):  # its file is gone, and it is not in use
                continue


class _Packer(pickle.Pickler):
    def reducer_override(self, thing: Any) -> Any:
        """Effects of users by their source, and kinds of cable by their effects."""
        if isinstance(thing, type) and issubclass(thing, Effect) and thing.file is not None:
            return _effect, _source_of(thing)
        if type(thing) is ModelClass:
            return ModelClass, tuple(getattr(thing, f) for f in ModelClass.__dataclass_fields__)
        return NotImplemented


def _source_of(effect: type[Effect]) -> _Source:
    """Path at the client, hash, source, and whether it is confined."""
    if effect not in _sources:
        assert effect.file is not None
        path, sha256 = effect.file.path, effect.file.sha256
        source = path.read_bytes()
        if hashlib.sha256(source).hexdigest() != sha256:
            raise WorkersError(f"{path}: was changed after it was read; run the command again")
        _know(effect, (str(path), sha256, source, is_remote(effect)))
    return _sources[effect]


def _know(effect: type[Effect], source: _Source) -> None:
    _sources[effect] = source
    _classes[source[:2]] = effect


def _effect(path: str, sha256: str, source: bytes, confined: bool) -> type[Effect]:
    """The class of a source; the same class for the same source."""
    if (path, sha256) not in _classes:
        if hashlib.sha256(source).hexdigest() != sha256:
            raise WorkersError(f"{path}: its source does not arrive whole; run the command again")
        # the sending process has tried it, and refuses endless effects
        file = _written(Path(path).name, sha256, source)
        if confined:
            confine_effects(file)
        effect = load_effect(file, trusted=True)
        _know(effect, (path, sha256, source, confined))
    return _classes[path, sha256]


def _written(name: str, sha256: str, source: bytes) -> Path:
    """File with a source, in a folder of this process."""
    global _folder
    if _folder is None:
        _folder = tempfile.TemporaryDirectory(prefix="cell-effects-", ignore_cleanup_errors=True)
    file = Path(_folder.name) / sha256 / name
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(source)
    return file


def _all_of(kind: type[Effect]) -> Iterator[type[Effect]]:
    for effect in kind.__subclasses__():
        yield effect
        yield from _all_of(effect)


def done(function: bytes, job: bytes) -> bytes:
    """Run a packed job with a packed function; returns its value and error, packed."""
    value, error = None, None
    try:
        value = unpack(function)(unpack(job))
    except Exception as raised:
        error = raised
    try:
        packed = pack((value, error))
        if error is not None:
            unpack(packed)  # fails for error classes with arguments of their own
    except Exception as unsendable:
        cause = unsendable if error is None else error
        return pack((None, RuntimeError(error_text(cause))))
    return packed


def result_of(number: int, packed: bytes) -> JobResult[Any]:
    """The result that `done` packed.  Raises WorkersError: the worker cannot do such jobs."""
    value, error = unpack(packed)
    if isinstance(error, WorkersError):
        raise error
    return JobResult(number, value, error)

"""Transforms between named frames, as ROS publishes them: paths of the outermost frames.

source  ROS, tf2_msgs/TFMessage and REP 103: place and turn of a child in its parent's frame, in
        metres, and a quaternion x, y, z, w
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.files.words import first_of
from cell.study.imports.contents import HAND
from cell.study.imports.documents import form_of, read_document
from cell.study.imports.groups import Tree
from cell.study.imports.text_content import head_of

#: Key of a transform's frame, and all keys of a transform.
_CHILD = "child_frame_id"
_KEYS = {_CHILD, "transform"}
#: Word in the name of a file of constant transforms.
_STATIC = "static"
#: Minimum share of common times of frames with one clock.
_ONE_CLOCK = 0.5
_MAX_DEPTH = 6
#: Name of the source of several frames that are not on one body.
_POINTS = "points"


@dataclass(frozen=True, eq=False)
class _Edge:
    """A frame in its parent at some times; constant if it has a single time.

    t_s      (n,) rising
    place_m  (n, 3)
    turn     n rotations
    """

    parent: str
    t_s: FloatArray
    place_m: FloatArray
    turn: Rotation

    @property
    def moves(self) -> bool:
        """Whether it has several times."""
        return len(self.t_s) > 1

    def at(self, t_s: FloatArray) -> tuple[FloatArray, Rotation]:
        """Places (n, 3), nan outside the edge's times, and turns at other times."""
        if not self.moves:
            return np.repeat(self.place_m, len(t_s), axis=0), self.turn[np.zeros(len(t_s), int)]
        within = np.clip(t_s, self.t_s[0], self.t_s[-1])
        place = np.column_stack([np.interp(within, self.t_s, p) for p in self.place_m.T])
        place[within != t_s] = np.nan
        return place, Slerp(self.t_s, self.turn)(within)


@dataclass(frozen=True, eq=False)
class _FramePath:
    """A frame's path in its root's frame; `body`: the innermost frame that moves it."""

    name: str
    body: str
    root: str
    t_s: FloatArray
    place_m: FloatArray
    turn: Rotation

    def columns(self, t_s: NDArray[np.float64]) -> dict[str, FloatArray]:
        """Coordinates and quaternion at the times of a source, nan where it has none."""
        rows = np.searchsorted(t_s, self.t_s)
        own = np.hstack([self.place_m, self.turn.as_quat()])
        values = np.full((len(t_s), own.shape[1]), np.nan)
        values[rows] = own
        titles = ("x", "y", "z", "qx", "qy", "qz", "qw")
        return {f"{self.name} {title}": values[:, k] for k, title in enumerate(titles)}


def holds_transforms(path: Path) -> bool:
    """Whether a file is a document that begins with transforms."""
    return _CHILD in head_of(path) and form_of(path) in ("lines", "json", "yaml")


def has_chains(content: Any) -> bool:
    """Whether a frame that has a parent is itself a parent, and a frame moves."""
    edges = _edges(content)
    moves = any(edge.moves for edge in edges.values())
    return moves and any(edge.parent in edges for edge in edges.values())


def only_constant(path: Path) -> bool:
    """Whether a file has transforms of which each is there once, as /tf_static."""
    edges = _edges(read_document(path).whole) if holds_transforms(path) else {}
    return bool(edges) and not any(edge.moves for edge in edges.values())


def static_files(path: Path) -> list[Path]:
    """Files of constant transforms in the folder of a file, by their names."""
    files = sorted(p for p in path.parent.glob(f"*{_STATIC}*") if p.is_file() and p != path)
    return [p for p in files if holds_transforms(p)]


def transform_notes(path: Path) -> list[str]:
    """Notes on the files of constant transforms that are used, and on frames without a path."""
    notes = [f"{path}: the constant transforms of {file.name} in its folder are used"
             for file in static_files(path)]  # fmt: skip
    roots: dict[str, list[str]] = {}
    for each in _outermost(_with_static(path, read_document(path).whole)):
        roots.setdefault(each.root, []).append(each.name)
    if len(roots) > 1:
        frames = "; ".join(f"{first_of(names, 3)} in {root!r}" for root, names in roots.items())
        sentence = f"{path}: no transform joins {frames}: if one is known, save it, as of "
        notes.append(f"{sentence}/tf_static, in this folder in a file with `{_STATIC}` in its name")
    return notes


def transforms_tree(path: Path, content: Any) -> tuple[Tree, dict[tuple[str, ...], str]]:
    """Paths of the outermost frames by source, at the source's times; empty = no transforms.

    Frames with one clock are one source.  Constant transforms may be in another file of the folder.

    raises  InputError: files contradict each other
    """
    tree: Tree = {}
    units: dict[tuple[str, ...], str] = {}
    for paths in _by_clock(_outermost(_with_static(path, content))):
        source = _source(paths, {key[0] for key in tree})
        t_s = np.unique(np.concatenate([p.t_s for p in paths]))
        tree[source, "time"], units[source, "time"] = t_s, "s"
        for each in paths:
            for name, values in each.columns(t_s).items():
                tree[source, name] = values
                units[source, name] = "m" if name[-2:] in (" x", " y", " z") else ""
    return tree, units


def _with_static(path: Path, content: Any) -> dict[str, _Edge]:
    """Each frame's transforms, with those of constant ones in the folder.  Raises InputError."""
    edges = _edges(content)
    if not any(edge.moves for edge in edges.values()):
        return {}
    for file in static_files(path):
        for name, edge in _edges(read_document(file).whole).items():
            if name in edges and edges[name].parent != edge.parent:
                message = f"places {name!r} in {edge.parent!r}, another file in "
                message += f"{edges[name].parent!r}; leave one of them in the folder"
                raise InputError.at(file, message)
            edges.setdefault(name, edge)
    return edges


def _edges(content: Any) -> dict[str, _Edge]:
    """Each frame's transforms to its parent, by its name."""
    rows: dict[str, dict[float, tuple[str, list[float]]]] = {}
    for each in _transforms(content):
        place, turn = (each["transform"].get(k) for k in ("translation", "rotation"))
        stamp_s, parent = _stamp(each)
        if isinstance(place, Mapping) and isinstance(turn, Mapping):
            numbers = [*(place.get(a, np.nan) for a in "xyz"), *(turn.get(a, 0.0) for a in "xyzw")]
            rows.setdefault(_bare(each[_CHILD]), {})[stamp_s] = (parent, numbers)
    edges = {}
    for name, by_time in rows.items():
        t_s = np.array(sorted(by_time))
        values = np.array([by_time[t][1] for t in t_s.tolist()], dtype=np.float64)
        turn_values = values[:, 3:]
        turn_values[~(np.linalg.norm(turn_values, axis=1) > 0.0)] = (0.0, 0.0, 0.0, 1.0)
        parent = by_time[t_s[0]][0]
        edges[name] = _Edge(parent, t_s, values[:, :3], Rotation.from_quat(turn_values))
    return edges


def _transforms(content: Any, depth: int = 0) -> Iterator[Mapping[str, Any]]:
    if isinstance(content, list) and depth <= _MAX_DEPTH:
        for item in content:
            yield from _transforms(item, depth + 1)
    elif isinstance(content, Mapping) and depth <= _MAX_DEPTH:
        if content.keys() >= _KEYS and isinstance(content["transform"], Mapping):
            yield content
        else:
            for item in content.values():
                yield from _transforms(item, depth + 1)


def _stamp(transform: Mapping[str, Any]) -> tuple[float, str]:
    """Time, s, and parent of a transform; 0 where it has no time."""
    header = transform.get("header") or {}
    stamp, parent = header.get("stamp", 0.0), _bare(header.get("frame_id", ""))
    if isinstance(stamp, Mapping):
        seconds, nanoseconds = (
            next((float(stamp[k]) for k in keys if k in stamp), 0.0)
            for keys in (("sec", "secs"), ("nanosec", "nsec", "nsecs"))
        )
        return seconds + 1e-9 * nanoseconds, parent
    return (float(stamp) if isinstance(stamp, int | float) else 0.0), parent


def _bare(name: object) -> str:
    return str(name).strip("/")


def _outermost(edges: Mapping[str, _Edge]) -> list[_FramePath]:
    """Paths of the moving frames that are no other frame's parent."""
    parents, paths = {edge.parent for edge in edges.values()}, list[_FramePath]()
    for name in edges:
        chain = _chain(name, edges)
        moving = [frame for frame in chain if edges[frame].moves]
        if name in parents or not moving:
            continue
        t_s = edges[moving[0]].t_s
        place, turn = edges[name].at(t_s)
        for frame in chain[1:]:
            origin, turned = edges[frame].at(t_s)
            place, turn = origin + turned.apply(place), turned * turn
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        if known.size:
            root = edges[chain[-1]].parent
            paths.append(_FramePath(name, moving[0], root, t_s[known], place[known], turn[known]))
    return paths


def _chain(name: str, edges: Mapping[str, _Edge]) -> list[str]:
    """Frames from one to the last below the root."""
    chain = [name]
    while (parent := edges[chain[-1]].parent) in edges and parent not in chain:
        chain.append(parent)
    return chain


def _by_clock(paths: Sequence[_FramePath]) -> list[list[_FramePath]]:
    """Paths with common root and, mostly, common times."""
    groups: list[list[_FramePath]] = []
    for path in sorted(paths, key=lambda p: -len(p.t_s)):
        for group in groups:
            common = np.isin(path.t_s, group[0].t_s).mean()
            if group[0].root == path.root and common >= _ONE_CLOCK:
                group.append(path)
                break
        else:
            groups.append([path])
    order = {path.name: i for i, path in enumerate(paths)}
    return [sorted(group, key=lambda p: order[p.name]) for group in groups]


def _source(paths: Sequence[_FramePath], taken: set[str]) -> str:
    """Name of a source: of the frame named after the gripper if all are on one body."""
    words = {p.name: re.findall("[a-z]+", p.name.lower()) for p in paths}
    named = [each for each in words.values() if HAND.intersection(each)] or list(words.values())
    of_body = len({p.body for p in paths}) == 1
    title = "_".join(named[0]) if of_body else ""
    title = title or _POINTS
    return title if title not in taken else f"{title}_{len(taken) + 1}"

"""A known swing as binary files: C3D, MCAP, .mat, Parquet, NumPy and HDF5."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .logs import sheet
from .swing import MARKERS, RATE_HZ, Swing
from .text import POINTS, cells, deeplabcut, likelihood, lines, space, turns

Floats = NDArray[np.float64]
_BLOCK = 512


def _group(number: int, name: str) -> bytes:
    return struct.pack("<bb", len(name), -number) + name.encode() + struct.pack("<hB", 3, 0)


def _parameter(number: int, name: str, kind: int, shape: Sequence[int], data: bytes) -> bytes:
    """kind: -1 characters, 2 whole numbers of 16 bits, 4 floats."""
    body = struct.pack("<bB", kind, len(shape)) + bytes(shape) + data + b"\0"
    head = struct.pack("<bb", len(name), number) + name.encode()
    return head + struct.pack("<h", len(body) + 2) + body


def _words(values: Sequence[str], width: int = 16) -> tuple[list[int], bytes]:
    return [width, len(values)], b"".join(v.encode().ljust(width)[:width] for v in values)


@dataclass(frozen=True)
class C3dExport:
    """How a C3D file is written.

    first   number of the first frame; the header has 16 bits for it, TRIAL:ACTUAL_START_FIELD 32
    scale   > 0: places are whole numbers of so much of a unit; < 0: they are floats
    fields  the group TRIAL is there
    """

    unit: str = "mm"
    first: int = 1
    scale: float = -1.0
    fields: bool = True
    up: int = 2


#: Blocks of the header and of the parameters.
_PARAMETER_BLOCKS = 3


def _c3d_head(export: C3dExport, frames: int) -> bytes:
    """Header and parameters."""
    points, last, scale = len(POINTS), export.first + frames - 1, export.scale
    parameters = [
        _group(1, "POINT"),
        _parameter(1, "USED", 2, [], struct.pack("<h", points)),
        _parameter(1, "SCALE", 4, [], struct.pack("<f", scale)),
        _parameter(1, "RATE", 4, [], struct.pack("<f", RATE_HZ)),
        _parameter(1, "DATA_START", 2, [], struct.pack("<h", _PARAMETER_BLOCKS + 2)),
        _parameter(1, "FRAMES", 2, [], struct.pack("<H", min(frames, 65535))),
        _parameter(1, "LABELS", -1, *_words(POINTS)),
        _parameter(1, "DESCRIPTIONS", -1, *_words([""] * points)),
        _parameter(1, "UNITS", -1, [4], export.unit.encode().ljust(4)),
        _group(2, "ANALOG"),
        _parameter(2, "USED", 2, [], struct.pack("<h", 0)),
        _parameter(2, "SCALE", 4, [0], b""),
        _parameter(2, "OFFSET", 2, [0], b""),
        _parameter(2, "LABELS", -1, [4, 0], b""),
        _parameter(2, "GEN_SCALE", 4, [], struct.pack("<f", 1.0)),
        _parameter(2, "RATE", 4, [], struct.pack("<f", 0.0)),
    ]
    if export.fields:
        parameters += [
            _group(3, "TRIAL"),
            _parameter(3, "ACTUAL_START_FIELD", 2, [2], struct.pack("<I", export.first)),
            _parameter(3, "ACTUAL_END_FIELD", 2, [2], struct.pack("<I", last)),
            _parameter(3, "CAMERA_RATE", 4, [], struct.pack("<f", RATE_HZ)),
        ]
    section = struct.pack("<BBBB", 1, 80, _PARAMETER_BLOCKS, 84) + b"".join(parameters)
    header = struct.pack(
        "<BBHHHHHfHHf", 2, 80, points, 0, min(export.first, 65535), min(last, 65535), 10, scale,
        _PARAMETER_BLOCKS + 2, 0, RATE_HZ,
    )  # fmt: skip
    return header.ljust(_BLOCK, b"\0") + section.ljust(_PARAMETER_BLOCKS * _BLOCK, b"\0")


def c3d(s: Swing, folder: Path, **options: Any) -> Path:
    """C3D, "The C3D file format user guide"; what is not seen has a residual of −1 and zeros.

    options  of `C3dExport`
    """
    export = C3dExport(**options)
    places = space(s, up=export.up, unit_m={"mm": 1e-3, "m": 1.0, "cm": 0.01}[export.unit])
    xyz = np.stack([places[n] for n in POINTS], axis=1)
    if export.scale > 0.0:  # 16 bits reach 32,767 steps: the origin is near the cable then
        xyz = xyz - [places["gripper"][0]]
    unseen = np.isnan(xyz).any(axis=2)
    residual = np.where(unseen, -1.0, 0.4)
    four = np.concatenate([np.nan_to_num(xyz), residual[:, :, None]], axis=2)
    if export.scale > 0.0:
        four[..., :3] /= export.scale
        four[..., 3] = np.where(unseen, -1.0, round(0.4 / export.scale) % 128)
        data = np.round(four).astype("<i2").tobytes()
    else:
        data = four.astype("<f4").tobytes()
    file = folder / f"{s.name}.c3d"
    file.write_bytes(_c3d_head(export, len(xyz)) + data + b"\0" * (-len(data) % _BLOCK))
    return file


_HEADER = """================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
_TURNED = """================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_PLACED = """================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
"""
_POSED = f"""================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_PLACED}{_TURNED}"""
_MESSAGES = {
    "geometry_msgs/msg/PoseStamped": f"std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    f"{_HEADER}{_POSED}",
    "geometry_msgs/msg/PointStamped": f"std_msgs/Header header\ngeometry_msgs/Point point\n"
    f"{_HEADER}{_PLACED}",
    "geometry_msgs/msg/PoseArray": f"std_msgs/Header header\ngeometry_msgs/Pose[] poses\n"
    f"{_HEADER}{_POSED}",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"
    "================================================================================\n"
    "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    f"geometry_msgs/Transform transform\n{_HEADER}"
    "================================================================================\n"
    "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation\n"
    "================================================================================\n"
    f"MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n{_TURNED}",
    "visualization_msgs/msg/MarkerArray": "visualization_msgs/Marker[] markers\n"
    "================================================================================\n"
    "MSG: visualization_msgs/Marker\nstd_msgs/Header header\nstring ns\nint32 id\nint32 type\n"
    f"int32 action\ngeometry_msgs/Pose pose\n{_HEADER}{_POSED}",
}

Message = tuple[str, str, dict[str, Any]]


def _xyz(place: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, place), strict=True))


def _pose(place: Sequence[float], turn: Sequence[float]) -> dict[str, Any]:
    return {
        "position": _xyz(place),
        "orientation": dict(zip("xyzw", map(float, turn), strict=True)),
    }


def _ros(s: Swing, kind: str) -> Iterator[tuple[float, list[Message]]]:
    """Time and messages (topic, type, content) of every row; places not seen are left out."""
    places = space(s, up=2, right=0, unit_m=1.0)
    quaternions = turns(s, (0.0, -1.0, 0.0)).as_quat()
    level = [0.0, 0.0, 0.0, 1.0]
    shuffle = np.random.default_rng(11)
    for k, t in enumerate(s.t_s):
        nanoseconds = round(t * 1e9)
        stamp = {"sec": 1_750_000_000 + nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        header = {"stamp": stamp, "frame_id": "world"}
        names = [n for n in ("gripper", *MARKERS) if np.isfinite(places[n][k]).all()]
        turn = {n: quaternions[k] if n == "gripper" else level for n in names}
        pose = {n: _pose(places[n][k], turn[n]) for n in names}
        gripper = ("/gripper", "geometry_msgs/msg/PoseStamped",
                   {"header": header, "pose": pose["gripper"]})  # fmt: skip
        cable = [n for n in names if n != "gripper"]
        if kind.startswith("tf"):
            order = list(shuffle.permutation(names)) if kind == "tf_shuffled" else names
            transforms = [
                {"header": header, "child_frame_id": n, "transform": {
                    "translation": pose[n]["position"], "rotation": pose[n]["orientation"]}}
                for n in order
            ]  # fmt: skip
            each = [transforms] if kind in ("tf_one", "tf_shuffled") else [[v] for v in transforms]
            yield t, [("/tf", "tf2_msgs/msg/TFMessage", {"transforms": e}) for e in each]
        elif kind == "poses":
            array = {"header": header, "poses": [pose[n] for n in cable]}
            yield t, [gripper, ("/cable", "geometry_msgs/msg/PoseArray", array)]
        elif kind.startswith("markers"):
            found = [
                {"header": header, "ns": "cable", "id": MARKERS.index(n), "type": 2, "action": 0,
                 "pose": pose[n]} for n in cable
            ]  # fmt: skip
            found = found[::-1] if kind == "markers_reversed" and k % 2 else found
            yield t, [gripper, ("/cable", "visualization_msgs/msg/MarkerArray", {"markers": found})]
        else:
            yield t, [gripper, *(
                (f"/{n}", "geometry_msgs/msg/PointStamped",
                 {"header": header, "point": pose[n]["position"]}) for n in cable
            )]  # fmt: skip


def ros_bag(s: Swing, folder: Path, *, kind: str) -> Path:
    """A ROS 2 bag: `tf`, `tf_one`, `tf_shuffled`, `poses`, `markers`, `markers_reversed`, `points`.

    `tf` has a transform in each message, `tf_one` all of a time in one.
    """
    from mcap_ros2.writer import Writer

    file = folder / f"{s.name}.mcap"
    writer = Writer(str(file))
    schemas = {name: writer.register_msgdef(name, text) for name, text in _MESSAGES.items()}
    for t, messages in _ros(s, kind):
        for topic, name, content in messages:
            at = 1_750_000_000 * 10**9 + round(t * 1e9)
            writer.write_message(topic, schemas[name], content, log_time=at, publish_time=at)
    writer.finish()
    return file


def json_log(s: Swing, folder: Path, *, summary: bool = True, end: bool = True) -> Path:
    """MCAP of JSON messages; without a summary, or cut off where the power was lost."""
    from mcap.writer import Writer

    file = folder / f"{s.name}.mcap"
    with file.open("wb") as stream:
        writer = Writer(
            stream, use_statistics=summary, use_summary_offsets=summary, repeat_channels=summary,
            repeat_schemas=summary, use_chunking=summary and end,
        )  # fmt: skip
        writer.start()
        schema = writer.register_schema("place", "jsonschema", b"{}")
        topics = ["/gripper", *(f"/{n}" for n in MARKERS)]
        channels = {t: writer.register_channel(t, "json", schema) for t in topics}
        for k, t in enumerate(s.t_s):
            at = 1_750_000_000 * 10**9 + round(t * 1e9)
            said = {"/gripper": (*s.gripper_m[k], s.angle_rad[k])}
            said |= {f"/{n}": tuple(p) for n, p in zip(MARKERS, s.markers_m[k], strict=True)}
            for topic, values in said.items():
                if not np.isfinite(values).all():
                    continue
                stamp = {"sec": at // 10**9, "nanosec": at % 10**9}
                content: dict[str, Any] = {"header": {"stamp": stamp}}
                content |= dict(zip(("x", "y", "angle"), map(float, values), strict=False))
                writer.add_message(channels[topic], at, json.dumps(content).encode(), at)
        if end:
            writer.finish()
        else:
            stream.flush()
    return file


def _columns(s: Swing) -> dict[str, Floats]:
    """Columns of a table by names that are identifiers, in s, mm and degrees."""
    names, values = sheet(s)
    made = [n.replace(" [", "_").replace("]", "").replace(" ", "_").replace("°", "deg")
            for n in names]  # fmt: skip
    return dict(zip(made, values.T, strict=True))


def _qtm(s: Swing, bodies: bool) -> dict[str, Any]:
    """Qualisys' structure: places and a residual of each marker, and the gripper as a body."""
    places = space(s, up=2, right=0)
    names = MARKERS if bodies else POINTS
    data = np.stack([places[n] for n in names])  # (points, T, 3)
    four = np.concatenate([data, np.full((*data.shape[:2], 1), 0.4)], axis=2)
    labeled = {
        "Count": len(names), "Labels": np.array([list(names)], dtype=object),
        "Data": four.transpose(0, 2, 1), "Type": np.ones((len(names), len(s.t_s))),
    }  # fmt: skip
    content: dict[str, Any] = {
        "File": f"{s.name}.qtm", "Timestamp": "2026-05-04, 14:11:10.201", "StartFrame": 1,
        "Frames": len(s.t_s), "FrameRate": RATE_HZ, "Trajectories": {"Labeled": labeled},
    }  # fmt: skip
    if bodies:
        turned = turns(s, (0.0, -1.0, 0.0))
        matrices = turned.as_matrix().transpose(0, 2, 1).reshape(len(s.t_s), 9)
        content["RigidBodies"] = {
            "Bodies": 1, "Name": np.array([["gripper"]], dtype=object),
            "Positions": places["gripper"].T[None], "Rotations": matrices.T[None],
            "RPYs": turned.as_euler("xyz", degrees=True).T[None],
            "Residual": np.full((1, 1, len(s.t_s)), 0.2),
        }  # fmt: skip
    return {s.name: content}


def _structure(s: Swing) -> dict[str, Any]:
    """Arrays as a script keeps them: times, places (rows, 2), markers (rows, markers, 2)."""
    return {
        "t_s": s.t_s, "gripper_m": s.gripper_m, "gripper_angle_rad": s.angle_rad,
        "markers_m": s.markers_m,
    }  # fmt: skip


def matlab(s: Swing, folder: Path, *, layout: str) -> Path:
    """MATLAB's save (v5): `columns`, `structure`, `matrices` or `markers`, a structure for each.

    `qtm` and `qtm_bodies` are Qualisys' export.
    """
    from scipy.io import savemat

    if layout == "columns":
        content: dict[str, Any] = {n: v[:, None] for n, v in _columns(s).items()}
    elif layout == "structure":
        content = {"trial": {**_structure(s), "fs": RATE_HZ}}
    elif layout == "matrices":
        content = {"t_s": s.t_s[:, None], "gripper_m": s.gripper_m,
                   "gripper_angle_rad": s.angle_rad[:, None]}  # fmt: skip
        content |= {f"{n}_m": s.markers_m[:, k] for k, n in enumerate(MARKERS)}
    elif layout == "markers":
        each = [{"name": n, "xy_m": s.markers_m[:, k]} for k, n in enumerate(MARKERS)]
        content = {**_structure(s), "markers": each}
        del content["markers_m"]
    else:
        content = _qtm(s, bodies=layout == "qtm_bodies")
    file = folder / f"{s.name}.mat"
    savemat(file, content)
    return file


def matlab_73(s: Swing, folder: Path, *, layout: str) -> Path:
    """MATLAB's -v7.3, which is HDF5 with its dimensions reversed and 512 bytes before it."""
    import h5py

    file = folder / f"{s.name}.mat"
    with h5py.File(file, "w", userblock_size=512) as store:
        if layout == "columns":
            for name, values in _columns(s).items():
                store[name] = values[None]
        else:
            group = store.create_group("trial")
            for name, values in {**_structure(s), "fs": np.array([[RATE_HZ]])}.items():
                group[name] = np.atleast_2d(values).T if np.ndim(values) != 1 else values[None]
        for item in _datasets(store):
            item.attrs["MATLAB_class"] = np.bytes_("double")
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM"
    with file.open("r+b") as stream:
        stream.write(text)
    return file


def _datasets(store: Any) -> Iterator[Any]:
    for item in store.values():
        yield from _datasets(item) if hasattr(item, "values") else [item]


def parquet(s: Swing, folder: Path, *, layout: str = "wide") -> Path:
    """`wide`, `long` (a row for each time and marker) or `lists` (a list in each cell)."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    if layout == "wide":
        table = pa.table(_columns(s))
    elif layout == "long":
        places = [s.gripper_m, *s.markers_m.transpose(1, 0, 2)]
        angle = [s.angle_rad, *[np.full(len(s.t_s), np.nan)] * len(MARKERS)]
        count = len(s.t_s)
        table = pa.table({
            "time_s": np.tile(s.t_s, len(places)),
            "label": [n for n in ("gripper", *MARKERS) for _ in range(count)],
            "x_m": np.concatenate([p[:, 0] for p in places]),
            "y_m": np.concatenate([p[:, 1] for p in places]),
            "angle_rad": np.concatenate(angle),
        })  # fmt: skip
    else:
        columns = {"timestamp": pa.array(s.t_s), "gripper_m": pa.array(s.gripper_m.tolist())}
        columns |= {"gripper_angle_rad": pa.array(s.angle_rad)}
        columns |= {f"{n}_m": pa.array(s.markers_m[:, k].tolist()) for k, n in enumerate(MARKERS)}
        table = pa.table(columns)
    file = folder / f"{s.name}.parquet"
    write_table(table, file)
    return file


def numpy_file(s: Swing, folder: Path, *, layout: str) -> Path:
    """`structured` .npy, `columns` or `arrays` in .npz, or `bare`: a matrix without names."""
    columns = _columns(s)
    if layout in ("structured", "bare"):
        file = folder / f"{s.name}.npy"
        values = np.column_stack(list(columns.values()))
        if layout == "structured":
            values = np.rec.fromarrays(list(columns.values()), names=list(columns))
        np.save(file, values)
        return file
    file = folder / f"{s.name}.npz"
    np.savez(file, **(columns if layout == "columns" else _structure(s)))
    return file


def csv_of(file: Path, s: Swing) -> Path:
    """A matrix without names, saved again as a table with names."""
    columns = _columns(s)
    other = file.with_suffix(".csv")
    other.write_text(lines([list(columns), *cells(np.load(file), 8)]))
    return other


def pandas_store(s: Swing, folder: Path) -> Path:
    """DeepLabCut's HDF5, a table of pandas: only pandas knows the names of its columns."""
    import h5py

    pixels, found = likelihood(s)
    values = np.concatenate([pixels, found[:, :, None]], axis=2).reshape(len(s.t_s), -1)
    row = np.dtype([("index", "<i8"), ("values_block_0", "<f8", (values.shape[1],))])
    table = np.zeros(len(s.t_s), dtype=row)
    table["index"], table["values_block_0"] = np.arange(len(s.t_s)), values
    file = folder / f"{s.name}DLC.h5"
    with h5py.File(file, "w") as store:
        store["df_with_missing/table"] = table
    return file


def csv_of_pandas(file: Path, s: Swing) -> Path:
    """The same as DeepLabCut saves it with `save_as_csv`."""
    return deeplabcut(s, file.parent)


def hdf5(s: Swing, folder: Path, *, layout: str, ending: str = ".h5") -> Path:
    """`columns`, `groups`, `table` (a compound data set), or `sleap`, its analysis file."""
    import h5py

    file = folder / f"{s.name}{ending}"
    with h5py.File(file, "w") as store:
        if layout == "columns":
            for name, values in _columns(s).items():
                store[name] = values
        elif layout == "table":
            columns = _columns(s)
            store["swing"] = np.rec.fromarrays(list(columns.values()), names=list(columns))
        elif layout == "groups":
            store["time"] = s.t_s
            store["time"].attrs["units"] = "s"
            places = {"gripper": s.gripper_m, **dict(zip(
                MARKERS, s.markers_m.transpose(1, 0, 2), strict=True))}  # fmt: skip
            for name, place in places.items():
                store[f"points/{name}/position"] = place * 1e3
                store[f"points/{name}/position"].attrs["units"] = "mm"
            store["points/gripper/angle"] = np.degrees(s.angle_rad)
            store["points/gripper/angle"].attrs["units"] = "deg"
        else:
            pixels, score = likelihood(s)
            pixels[score < 0.5] = np.nan
            names = np.array([n.encode() for n in POINTS])
            store["tracks"] = pixels.transpose(2, 1, 0)[None]  # (tracks, 2, nodes, frames)
            store["node_names"] = names
            store["track_names"] = np.array([b"cable"])
            store["track_occupancy"] = np.ones((len(s.t_s), 1), dtype=np.uint8)
            store["point_scores"] = score.T[None]
            store["instance_scores"] = np.full((1, len(s.t_s)), 0.98)
            store["tracking_scores"] = np.full((1, len(s.t_s)), 0.0)
            store["edge_names"] = np.array([[b"gripper", b"m1"]])
            store["edge_inds"] = np.array([[0, 2]])
            store["video_path"] = "swing.mp4"
            store["video_ind"] = 0
    return file

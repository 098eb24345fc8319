"""A hundred files of thirty programs, each with the study that it must become.

Layouts are those that the programs document; all numbers are of `swing.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from . import binary, logs, others, text
from .swing import BACK_M, RATE_HZ, Swing, arm_study, known_study, straight_study

#: A file of the markers, or with a file of the gripper.
Written = Path | tuple[Path, Path]


@dataclass(frozen=True)
class Remedy:
    """What a refusal, or a doubt that the proposal states, must name, and what is then given.

    says     in any letters, a part of the refusal or of a sentence that is marked GUESS or GIVE
    options  of the command, by the names of `Stated`
    edits    entries of the mapping, by their path
    mend     writes a file of a trial again
    """

    says: str
    options: Mapping[str, float] = field(default_factory=dict)
    edits: Mapping[str, Any] = field(default_factory=dict)
    mend: Callable[[Path, Swing], Path] | None = None


@dataclass(frozen=True)
class Entry:
    """One export of a program.

    write        writes a trial into a folder
    study        the trials that it holds
    rate_hz      that somebody gives with --rate
    lost         the tip is not seen in some rows
    rounding_m, rounding_rad  by which the file's own digits, or an integral, may differ
    """

    program: str
    export: str
    write: Callable[[Swing, Path], Written]
    study: Callable[[], tuple[Swing, ...]] = known_study
    rate_hz: float | None = None
    lost: bool = False
    remedy: Remedy | None = None
    rounding_m: float = 0.0
    rounding_rad: float = 0.0

    @property
    def name(self) -> str:
        """Program and export."""
        return f"{self.program}, {self.export}"

    def trials(self) -> list[Swing]:
        """What the study must hold."""
        return [s.with_lost_tip() if self.lost else s for s in self.study()]


def _named_columns(file: Path, _: Swing) -> Path:
    """A line of names above a table without any, as the refusal asks for it."""
    width = len(file.read_text().partition("\n")[0].split(","))
    points = ["gripper", "gripper_back", *text.MARKERS]
    names = ["frame", "time_s", *(f"{n}_{a}_m" for n in points for a in "xyz")]
    assert len(names) == width
    file.write_text(",".join(names) + "\n" + file.read_text())
    return file


_OF_PIXELS = Remedy("metres_per_unit", edits={"metres_per_unit": 0.0005})
_BASE = Remedy("origin_m", edits={"hand.origin_m": list(logs.BASE_M)})
_CONSTANT = {"hand.angle.constant_rad": 0.2}
_AXLE_M = 0.1
_arm = partial(arm_study, _AXLE_M)
_ON_AXLE = {"hand.turns.axle_m": [0.0, 0.0], "hand.turns.radius_m": _AXLE_M}
_ACCELERATED = {
    "hand.acceleration.starts_at_m": [0.0, 0.0], **_CONSTANT,
    "trials.0.hand_ends_at_m": [0.0, -0.05],
}  # fmt: skip


def _accelerometer(s: Swing, folder: Path, **options: Any) -> Written:
    return logs.accelerometer(s, folder, way_m=0.05, **options)


def _trimmed(s: Swing, folder: Path) -> Written:
    """Frames from 2.5 s of the clock on by which the gripper is logged, too."""
    return binary.c3d(s, folder, first=501), logs.laboratory_log(s, folder, begins_s=2.5)


def _first() -> tuple[Swing, ...]:
    return straight_study()[:1]


MOTIVE = [
    Entry("OptiTrack Motive", export, partial(text.motive, **options), lost=lost)
    for export, options, lost in (
        ("rigid body, quaternion", {}, False),
        ("rigid body, Euler XYZ", {"rotation": "XYZ"}, False),
        ("centimetres", {"unit": "Centimeters"}, False),
        ("millimetres, Euler XYZ", {"unit": "Millimeters", "rotation": "XYZ"}, False),
        ("markers only", {"body": False}, False),
        ("rigid body markers", {"body_markers": True}, False),
        ("rigid body markers, quality", {"body_markers": True, "quality": True}, True),
        ("unlabeled markers", {"unlabeled": True}, False),
        ("all columns", {"body_markers": True, "quality": True, "unlabeled": True}, True),
        ("rate below that of capture", {"capture_hz": 400.0}, False),
        ("version 1.25, gaps", {"version": "1.25"}, True),
    )
] + [
    Entry(
        "OptiTrack Motive", "no header", partial(text.motive, body=False, header=False),
        remedy=Remedy("names", mend=_named_columns),
    )
]  # fmt: skip
VICON = [
    Entry("Vicon Nexus", export, partial(text.nexus, **options), lost=lost)
    for export, options, lost in (
        ("trajectories", {}, False),
        ("devices before trajectories", {"sections": ("Devices", "Trajectories")}, False),
        ("trajectories before devices", {"sections": ("Trajectories", "Devices")}, False),
        ("model outputs first", {"sections": ("Model Outputs", "Trajectories")}, True),
        ("three sections", {"sections": ("Devices", "Model Outputs", "Trajectories")}, True),
        ("first frame 501, no subject", {"first": 501, "subject": ""}, True),
        ("semicolons", {"semicolons": True}, False),
    )
] + [Entry("Vicon Tracker", "objects", text.vicon_tracker)]
QUALISYS = [
    Entry("Qualisys Track Manager", export, partial(text.qtm, **options), lost=lost,
          rate_hz=rate_hz, remedy=remedy)
    for export, options, lost, rate_hz, remedy in (
        ("TSV, zero fill", {}, True, None, None),
        ("TSV, blank fill", {"lost": ""}, True, None, None),
        ("TSV, NULL fill", {"lost": "NULL"}, True, None, None),
        ("TSV without types", {"types": False}, False, None, None),
        ("TSV of version 2", {"version": True}, True, None, None),
        ("TSV without frame and time", {"counted": False, "names": False}, True, RATE_HZ, None),
        ("TSV without names", {"names": False}, False, None, None),
        ("TSV of a turned plane", {"turned_rad": 0.6}, False, None, None),
    )
] + [
    Entry("Qualisys Track Manager", "TSV 3D and 6D", text.qtm_bodies),
    Entry("Qualisys Track Manager", "MAT of bodies", partial(binary.matlab, layout="qtm_bodies")),
    Entry("Qualisys Track Manager", "MAT", partial(binary.matlab, layout="qtm"), lost=True),
]  # fmt: skip
C3D = [
    Entry(program, f"C3D, {export}", partial(binary.c3d, **options), lost=lost,
          rounding_m=rounding_m, rounding_rad=3.0 * rounding_m / BACK_M)
    for program, export, options, lost, rounding_m in (
        ("Qualisys Track Manager", "millimetres", {}, False, 0.0),
        ("Vicon Nexus", "metres", {"unit": "m"}, False, 0.0),
        ("Vicon Nexus", "trimmed", {"first": 501}, False, 0.0),
        ("Vicon Nexus", "trimmed, no group TRIAL", {"first": 501, "fields": False}, False, 0.0),
        ("Vicon Nexus", "beyond frame 65,535", {"first": 70_001}, True, 0.0),
        ("Qualisys Track Manager", "residuals of −1", {}, True, 0.0),
        ("Theia3D", "whole numbers and a scale", {"scale": 0.01}, True, 5.1e-6),
        ("PhaseSpace", "centimetres, y up", {"unit": "cm", "up": 1}, False, 0.0),
    )
] + [
    Entry("Vicon Nexus", "C3D, trimmed, with a robot's log", _trimmed),
]  # fmt: skip
OPENSIM = [
    Entry("OpenSim", export, partial(text.trc, **options), lost=lost)
    for export, options, lost in (
        ("TRC", {}, False),
        ("TRC, metres, gaps", {"unit": "m"}, True),
        ("TRC, another original rate", {"original_hz": 400.0, "first": 101}, False),
        ("TRC, cut lines", {"cut": True}, True),
    )
] + [
    Entry("OpenSim", "storage file", text.storage),
    Entry("Cortex", "TRC of six keys", partial(text.trc, keys=False), lost=True),
]
VIDEO = [
    Entry("Kinovea", "CSV, centimetres", partial(text.kinovea, form="csv")),
    Entry("Kinovea", "CSV, milliseconds", partial(text.kinovea, form="ms"), lost=True),
    Entry("Kinovea", "CSV, pixels", partial(text.kinovea, form="pixels"), remedy=_OF_PIXELS),
    Entry("Kinovea", "text of trajectories", text.kinovea_text),
    Entry("Tracker", "tabs", text.tracker),
    Entry("Tracker", "decimal commas, gaps", partial(text.tracker, mark=","), lost=True),
    Entry("Tracker", "commas", partial(text.tracker, separator=",")),
    Entry("DeepLabCut", "CSV", text.deeplabcut, rate_hz=RATE_HZ, remedy=_OF_PIXELS),
    Entry("DeepLabCut", "CSV, low likelihood", text.deeplabcut, rate_hz=RATE_HZ, lost=True,
          remedy=_OF_PIXELS),
    Entry("DeepLabCut", "HDF5", binary.pandas_store, rate_hz=RATE_HZ,
          remedy=Remedy("csv", edits=_OF_PIXELS.edits, mend=binary.csv_of_pandas)),
    Entry("SLEAP", "analysis CSV", text.sleap, rate_hz=RATE_HZ, lost=True, remedy=_OF_PIXELS),
    Entry("SLEAP", "analysis CSV with a track", partial(text.sleap, track="track_0"),
          rate_hz=RATE_HZ, remedy=_OF_PIXELS),
    Entry("SLEAP", "analysis HDF5", partial(binary.hdf5, layout="sleap", ending=".analysis.h5"),
          rate_hz=RATE_HZ, lost=True, remedy=_OF_PIXELS),
]  # fmt: skip
OTHER_CAPTURE = [
    Entry("PhaseSpace", "CSV, zero fill", text.phasespace, lost=True),
    Entry("NDI First Principles", "CSV", text.first_principles, lost=True),
    Entry("PlotJuggler", "CSV", text.plotjuggler),
]
ROS = [
    Entry("ROS 2", export, partial(binary.ros_bag, kind=kind), lost=lost)
    for export, kind, lost in (
        ("tf, one transform in a message", "tf", True),
        ("tf, all in one message", "tf_one", False),
        ("tf, shuffled", "tf_shuffled", True),
        ("PoseArray", "poses", False),
        ("MarkerArray", "markers", True),
        ("MarkerArray in either order", "markers_reversed", False),
        ("PointStamped", "points", True),
    )
] + [
    Entry("Foxglove", "MCAP of JSON", binary.json_log, lost=True),
    Entry("Foxglove", "MCAP without summary", partial(binary.json_log, summary=False)),
    Entry("Foxglove", "MCAP without end", partial(binary.json_log, end=False)),
]
EXCEL = [
    Entry("Excel", export, partial(logs.excel, **options), lost=lost, remedy=remedy,
          rounding_m=rounding_m)
    for export, options, lost, rounding_m, remedy in (
        ("German", {"language": "de"}, True, 0.0, None),
        ("German, cp1252", {"language": "de", "encoding": "cp1252"}, False, 0.0, None),
        ("German, thousands", {"language": "de", "thousands": "."}, False, 0.0, None),
        ("German, #NV", {"language": "de", "codes": True}, True, 0.0, None),
        ("German, dates", {"language": "de", "times": "de"}, False, 0.0, None),
        ("French, cp1252", {"language": "fr", "encoding": "cp1252"}, False, 0.0, None),
        ("French, thousands", {"language": "fr", "thousands": "\u202f"}, False, 0.0, None),
        ("French, #N/A", {"language": "fr", "codes": True}, True, 0.0, None),
        ("English", {"language": "en"}, True, 0.0, None),
        ("English, thousands", {"language": "en", "thousands": ","}, False, 0.0, None),
        ("English, dates", {"language": "en", "times": "en"}, False, 0.0, None),
        ("English, times of day", {"language": "en", "times": "clock"}, False, 0.0, None),
        ("English, serial dates", {"language": "en", "times": "serial"}, False, 0.0,
         Remedy("time", edits={"time.seconds_per_unit": 86400.0})),
    )
] + [
    Entry("Excel", "German, dates to the second",
          partial(logs.excel, language="de", times="coarse"),
          remedy=Remedy("--rate", options={"rate_hz": RATE_HZ})),
    Entry("Excel", "workbook", logs.workbook, lost=True),
    Entry("Excel", "workbook, dates", partial(logs.workbook, dates=True)),
    Entry("Excel", "workbook, second sheet", partial(logs.workbook, title=True)),
]  # fmt: skip
SCRIPTS = [
    Entry("pandas", "CSV with an index", partial(logs.plain, style="pandas"), lost=True),
    Entry("R", "write.csv", partial(logs.plain, style="r"), lost=True),
    Entry("LabVIEW", "measurement file", partial(logs.plain, style="labview")),
    Entry("Arduino", "serial monitor", partial(logs.plain, style="arduino")),
    Entry("MATLAB", "writetable", partial(logs.plain, style="matlab"), lost=True),
    Entry("MATLAB", ".mat, columns", partial(binary.matlab, layout="columns"), lost=True),
    Entry("MATLAB", ".mat, structure", partial(binary.matlab, layout="structure")),
    Entry("MATLAB", ".mat, matrices", partial(binary.matlab, layout="matrices"), lost=True),
    Entry("MATLAB", ".mat -v7.3, columns", partial(binary.matlab_73, layout="columns")),
    Entry("MATLAB", ".mat -v7.3, structure", partial(binary.matlab_73, layout="structure"),
          lost=True),
    Entry("MATLAB", ".mat, a structure for each marker",
          partial(binary.matlab, layout="markers"), lost=True),
    Entry("gnuplot", "columns of blanks", partial(logs.plain, style="gnuplot")),
    Entry("Parquet", "wide", binary.parquet, lost=True),
    Entry("Parquet", "long", partial(binary.parquet, layout="long")),
    Entry("Parquet", "lists", partial(binary.parquet, layout="lists")),
    Entry("NumPy", "structured array", partial(binary.numpy_file, layout="structured"), lost=True),
    Entry("NumPy", "columns", partial(binary.numpy_file, layout="columns")),
    Entry("NumPy", "arrays", partial(binary.numpy_file, layout="arrays"), lost=True),
    Entry("NumPy", "matrix without names", partial(binary.numpy_file, layout="bare"),
          remedy=Remedy("names", mend=binary.csv_of)),
    Entry("HDF5", "columns", partial(binary.hdf5, layout="columns"), lost=True),
    Entry("HDF5", "groups", partial(binary.hdf5, layout="groups", ending=".hdf5")),
    Entry("HDF5", "compound table", partial(binary.hdf5, layout="table")),
]  # fmt: skip
OTHERS = [
    Entry("BTS SMART", "ending of its own", others.own_ending),
    Entry("NOKOV", "TRC with a header in GBK", others.chinese),
    Entry("InfluxDB", "line protocol", others.line_protocol),
    Entry("Adams", "columns called by letters", others.legend),
    Entry("OpenSim", "three coordinates in a cell", others.vectors),
    Entry("Foxglove", "messages with two times", others.stamped_json),
    Entry("ROS 2", "messages received twice", others.received_twice),
    Entry("LabVIEW", "a comment in the first row", others.labview),
    Entry("Octave", "text of variables", others.octave, lost=True),
    Entry("Octave", "text called .mat", partial(others.octave, ending="mat")),
    Entry("gnuplot", "blocks of a frame", others.blocks, lost=True),
    Entry("gnuplot", "comments between frames", partial(others.blocks, gap="")),
    Entry("OpenCV", "corners of tags", others.aruco, lost=True, remedy=_OF_PIXELS),
]
ROBOTS = [
    Entry("Universal Robots", "record", logs.ur, remedy=_BASE),
    Entry("Universal Robots", "RTDE with commas", partial(logs.ur, separator=","), remedy=_BASE),
    Entry("Universal Robots", "record in the markers' frame", partial(logs.ur, in_base=False)),
    Entry("KUKA", "trace", logs.kuka, remedy=_BASE),
    Entry("KUKA", "trace, German", partial(logs.kuka, german=True), remedy=_BASE),
    Entry("ABB", "TCP and quaternion", logs.abb, remedy=_BASE),
    Entry("Fanuc", "X Y Z W P R", logs.fanuc, remedy=_BASE),
    Entry("Franka", "O_T_EE", logs.franka, remedy=_BASE),
    Entry("Robot script", "metres beside millimetres", logs.planar_log),
    Entry("Robot script", "centimetres", partial(logs.planar_log, unit="_cm", unit_m=0.01)),
]
SENSORS = [
    Entry("Encoder", "degrees of an axle", logs.encoder_on_axle, study=_arm,
          remedy=Remedy("radius_m", edits=_ON_AXLE)),
    Entry("Encoder", "counts of an axle", partial(logs.encoder_on_axle, counts=2**23), study=_arm,
          remedy=Remedy("radians_per_unit", edits={
              **_ON_AXLE, "hand.turns.radians_per_unit": 6.283185307179586 / 2**23})),
    Entry("Encoder", "linear, of a rail", logs.encoder_of_rail, study=straight_study,
          remedy=Remedy("constant", edits=_CONSTANT)),
    Entry("Accelerometer", "m/s²",
          partial(_accelerometer, names=("time_s", "ax [m/s^2]", "ay [m/s^2]")),
          study=_first, rounding_m=5e-5, remedy=Remedy("starts_at_m", edits=_ACCELERATED)),
    Entry("Accelerometer", "phyphox, g",
          partial(_accelerometer, unit=9.80665,
                  names=("Time (s)", "Acceleration x (g)", "Acceleration y (g)")),
          study=_first, rounding_m=5e-5, remedy=Remedy("starts_at_m", edits=_ACCELERATED)),
]  # fmt: skip
CORPUS = [
    *MOTIVE, *VICON, *QUALISYS, *C3D, *OPENSIM, *VIDEO, *OTHER_CAPTURE, *ROS, *EXCEL, *SCRIPTS,
    *ROBOTS, *SENSORS, *OTHERS,
]  # fmt: skip

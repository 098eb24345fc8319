"""ROS 2 and protobuf messages are read as their JSON is, by the numbers in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from cell.cli import app
from cell.files.input_error import InputError
from cell.study.folder import read_study
from cell.study.imports.mcap_file import read_mcap
from tests.cell.study.imports.made import CABLE, NAMES, Made, made

_POSE = """std_msgs/Header header
geometry_msgs/Pose pose
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def _turns(m: Made) -> np.ndarray:
    """A gripper whose +x is where the cable leaves, in a plane of x and z: about −y."""
    return Rotation.from_rotvec((np.pi + m.angle_rad)[:, None] * [0.0, -1.0, 0.0]).as_quat()


def ros2(m: Made, file: Path) -> None:
    """A PoseStamped of the gripper and one of each marker."""
    writer = Ros2Writer(str(file))
    schema = writer.register_msgdef("geometry_msgs/msg/PoseStamped", _POSE)
    turns = _turns(m)
    for k, t in enumerate(m.t_s):
        stamp = {"sec": 1_700_000_000 + int(t), "nanosec": round((t - int(t)) * 1e9)}
        places = {"/hand": m.hand_m[k], **dict(zip(NAMES, m.markers_m[k], strict=True))}
        for name, (x, z) in places.items():
            turn = turns[k] if name == "/hand" else [0.0, 0.0, 0.0, 1.0]
            pose = {
                "position": {"x": x, "y": 0.3, "z": z},
                "orientation": dict(zip("xyzw", map(float, turn), strict=True)),
            }
            message = {"header": {"stamp": stamp, "frame_id": "map"}, "pose": pose}
            topic = name if name.startswith("/") else f"/{name}"
            writer.write_message(topic, schema, message, log_time=int(1.7e18 + 1e9 * t))
    writer.finish()


def protobuf(m: Made, file: Path) -> None:
    """A pose of the gripper, and all markers in one message."""
    turns = _turns(m)
    with file.open("wb") as stream, ProtobufWriter(stream) as writer:
        for k, t in enumerate(m.t_s):
            nanoseconds = int(1.7e18) + round(1e9 * t)
            hand, cable = PoseInFrame(), PosesInFrame()
            for message in (hand, cable):
                message.timestamp.FromNanoseconds(nanoseconds)
            x, z = m.hand_m[k]
            hand.pose.position.x, hand.pose.position.y, hand.pose.position.z = x, 0.3, z
            for axis, value in zip("xyzw", turns[k], strict=True):
                setattr(hand.pose.orientation, axis, value)
            for x, z in m.markers_m[k]:
                place = cable.poses.add().position
                place.x, place.y, place.z = x, 0.3, z
            writer.write_message("/hand", hand, nanoseconds, nanoseconds)
            writer.write_message("/cable", cable, nanoseconds, nanoseconds)


@pytest.mark.parametrize("write", [ros2, protobuf])
def test_a_recording_of_a_robot_is_the_trial(write, tmp_path: Path) -> None:
    m, file, runner = made(), tmp_path / "robot.mcap", CliRunner()
    write(m, file)
    proposed = runner.invoke(app, ["import", str(file), "-o", str(tmp_path / "s"), *CABLE])
    assert proposed.exit_code == 0, proposed.output
    written = runner.invoke(app, ["import", str(tmp_path / "s" / "import.yaml")])
    assert written.exit_code == 0, written.output
    (trial,) = read_study(tmp_path / "s").trials
    np.testing.assert_allclose(trial.markers.t_s, m.t_s, atol=1e-6)
    np.testing.assert_allclose(trial.markers.xy_m, m.markers_m[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(trial.grip.angle_rad, m.angle_rad, atol=1e-9)


def test_what_cannot_be_decoded_is_named(tmp_path: Path) -> None:
    file = tmp_path / "t.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("x", "", b"")
        channel = writer.register_channel("/lidar", "cbor", schema)
        writer.add_message(channel, 1, b"\x01", 1)
        writer.finish()
    with pytest.raises(InputError, match=r"topic /lidar \(cbor\) cannot be decoded"):
        read_mcap(file)

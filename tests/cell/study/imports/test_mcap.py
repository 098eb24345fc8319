"""Protobuf messages are read by the numbers in them; `corpus` has JSON and ROS 2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from scipy.spatial.transform import Rotation

from cell.files.input_error import InputError
from cell.study.imports.mcap_file import read_mcap
from tests.cell.study.imports.corpus.swing import Swing
from tests.cell.study.imports.made import imported, made


def _turns(m: Swing) -> np.ndarray:
    """A gripper whose +x is where the cable leaves, in a plane of x and z: about −y."""
    return Rotation.from_rotvec((np.pi + m.angle_rad)[:, None] * [0.0, -1.0, 0.0]).as_quat()


def protobuf(m: Swing, file: Path) -> None:
    """A pose of the gripper, and all markers in one message."""
    turns = _turns(m)
    with file.open("wb") as stream, ProtobufWriter(stream) as writer:
        for k, t in enumerate(m.t_s):
            nanoseconds = int(1.7e18) + round(1e9 * t)
            hand, cable = PoseInFrame(), PosesInFrame()
            for message in (hand, cable):
                message.timestamp.FromNanoseconds(nanoseconds)
            x, z = m.gripper_m[k]
            hand.pose.position.x, hand.pose.position.y, hand.pose.position.z = x, 0.3, z
            for axis, value in zip("xyzw", turns[k], strict=True):
                setattr(hand.pose.orientation, axis, value)
            for x, z in m.markers_m[k]:
                place = cable.poses.add().position
                place.x, place.y, place.z = x, 0.3, z
            writer.write_message("/hand", hand, nanoseconds, nanoseconds)
            writer.write_message("/cable", cable, nanoseconds, nanoseconds)


def test_a_recording_of_a_robot_is_the_trial(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "robot.mcap"
    protobuf(m, file)
    (trial,) = imported([str(file)], tmp_path / "s").trials
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

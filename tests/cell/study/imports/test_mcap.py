"""Protobuf messages are read by the numbers in them; `corpus` has JSON and ROS 2."""

from __future__ import annotations

import json
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


def _stamped(t_s: float, parent: str, child: str, place: np.ndarray, turn: Rotation) -> object:
    stamp = {"sec": int(t_s), "nanosec": round(t_s % 1.0 * 1e9)}
    pose = {"translation": dict(zip("xyz", place.tolist(), strict=True)),
            "rotation": dict(zip("xyzw", turn.as_quat().tolist(), strict=True))}  # fmt: skip
    return {"header": {"stamp": stamp, "frame_id": parent}, "child_frame_id": child,
            "transform": pose}  # fmt: skip


def test_chains_of_transforms_are_places_in_the_outermost_frame(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "tf.mcap"
    camera = np.array([0.4, -0.6, 0.3]), Rotation.from_euler("xyz", [0.3, -1.2, 0.8])
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("tf", "jsonschema", b"{}")
        topics = {t: writer.register_channel(t, "json", schema) for t in ("/tf", "/tf_static")}

        def send(topic: str, t_s: float, transforms: list[object]) -> None:
            text = json.dumps({"transforms": transforms}).encode()
            writer.add_message(topics[topic], round(t_s * 1e9), text, round(t_s * 1e9))

        send("/tf_static", 1.0, [_stamped(1.0, "base", "optical", *camera)])
        turns = Rotation.from_quat(_turns(m))
        for k, t in enumerate(m.t_s):
            hand = np.array([m.gripper_m[k, 0], 0.1, m.gripper_m[k, 1]])
            send("/tf", 10.0 + t, [_stamped(10.0 + t, "base", "tool", hand, turns[k])])
            seen = [camera[1].inv().apply([x, 0.1, z] - camera[0]) for x, z in m.markers_m[k]]
            tags = [_stamped(10.0 + t, "optical", f"tag_{i}", place, Rotation.identity())
                    for i, place in enumerate(seen)]  # fmt: skip
            send("/tf", 10.0 + t, tags)
        writer.finish()
    read = read_mcap(file)
    np.testing.assert_allclose(read.at(["tool x", "tool z"]), m.gripper_m, atol=1e-7)
    np.testing.assert_allclose(read.at(["tag_4 x", "tag_4 z"]), m.markers_m[:, 4], atol=1e-7)
    (trial,) = imported([str(file)], tmp_path / "s").trials
    np.testing.assert_allclose(trial.markers.xy_m, m.markers_m[:, ::-1], atol=1e-6)
    np.testing.assert_allclose(trial.grip.angle_rad, m.angle_rad, atol=1e-6)

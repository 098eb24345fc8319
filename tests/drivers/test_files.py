from __future__ import annotations

import subprocess
import sys
from pathlib import Path as FilePath

import numpy as np
import pytest

from drivers.files import FilesCamera, write_frames, write_picture
from drivers.interfaces import CameraError, ConnectError, Frame
from drivers.sim.clock import SimClock

TIMES = [10.0, 10.1, 10.2, 10.35]


@pytest.fixture
def folder(tmp_path) -> FilePath:
    rng = np.random.default_rng(0)
    frames = [
        Frame(i, t, rng.integers(0, 256, (6, 8), dtype=np.uint8)) for i, t in enumerate(TIMES)
    ]
    write_frames(tmp_path / "recording", frames)
    return tmp_path / "recording"


def test_replays_what_was_written(folder) -> None:
    camera = FilesCamera(folder)
    camera.connect()
    camera.start(4)
    frames = list(iter(camera.read, None))
    rng = np.random.default_rng(0)
    for frame, t_s in zip(frames, TIMES, strict=True):
        assert frame.t_s == t_s
        assert np.array_equal(frame.image, rng.integers(0, 256, (6, 8), dtype=np.uint8))
    assert camera.frame_rate_hz == pytest.approx(10.0)


def test_a_second_recording_goes_on_where_the_first_ended(folder) -> None:
    camera = FilesCamera(folder)
    camera.connect()
    for first in (10.0, 10.2):
        camera.start(2)
        frames = list(iter(camera.read, None))
        assert [f.index for f in frames] == [0, 1]
        assert frames[0].t_s == first
    with pytest.raises(CameraError, match=r"1 frames asked for, 0 of 4 pictures are left"):
        camera.start(1)


def test_with_a_clock_the_recording_begins_now(folder) -> None:
    clock = SimClock(start_s=100.0)
    camera = FilesCamera(folder, clock=clock)
    camera.connect()
    camera.start(4)
    frames = list(iter(camera.read, None))
    assert [f.t_s for f in frames] == pytest.approx([100.0, 100.1, 100.2, 100.35])
    assert clock.now_s() == pytest.approx(100.35)


def test_pictures_without_times_come_in_order_of_their_names(tmp_path) -> None:
    for k in (2, 0, 1):
        write_picture(tmp_path / f"p{k}.png", np.full((4, 4), 10 * k, dtype=np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    camera = FilesCamera(tmp_path, frame_rate_hz=200.0)
    camera.connect()
    camera.start(3)
    frames = list(iter(camera.read, None))
    assert [int(f.image[0, 0]) for f in frames] == [0, 10, 20]
    assert [f.t_s for f in frames] == pytest.approx([0.0, 0.005, 0.01])


def test_a_folder_without_times_needs_a_rate(tmp_path) -> None:
    with pytest.raises(ConnectError, match=r"frames.csv is missing; write it, or give the frame"):
        FilesCamera(tmp_path).connect()
    with pytest.raises(ConnectError, match="holds no pictures"):
        FilesCamera(tmp_path, frame_rate_hz=1.0).connect()
    with pytest.raises(ConnectError, match="is not a folder"):
        FilesCamera(tmp_path / "nowhere").connect()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("file,time\n", r"frames.csv:1: needs the columns file,t_s"),
        ("file,t_s\nframe_000000.png,abc\n", r"frames.csv:2: t_s = 'abc' is not a number"),
        ("file,t_s\nframe_000000.png\n", r"frames.csv:2: t_s = None is not a number"),
        ("file,t_s\nnowhere.png,1\n", r"frames.csv:2: .*nowhere.png is missing"),
        (
            "file,t_s\nframe_000000.png,1\nframe_000001.png,1\n",
            r"frames.csv:3: t_s = 1.0 s, times must increase",
        ),
    ],
)
def test_a_bad_table_is_named_with_its_line(folder, table, message) -> None:
    (folder / "frames.csv").write_text(table)
    with pytest.raises(ConnectError, match=message):
        FilesCamera(folder).connect()


def test_a_file_that_is_no_picture_is_named(folder) -> None:
    (folder / "frame_000001.png").write_text("not a picture")
    camera = FilesCamera(folder)
    camera.connect()
    camera.start(4)
    camera.read()
    with pytest.raises(CameraError, match=r"frame_000001.png is not a picture"):
        camera.read()


def test_an_unwritable_place_is_an_error(tmp_path) -> None:
    with pytest.raises(OSError, match="could not be written"):
        write_picture(tmp_path / "nowhere" / "a.png", np.zeros((4, 4), dtype=np.uint8))


def test_a_file_that_is_no_video_is_said_in_one_line(tmp_path: FilePath) -> None:
    """The libraries that read it write nothing of their own."""
    file = tmp_path / "film.avi"
    file.write_bytes(b"RIFF\0\0\0\0AVI LIST no video at all")
    read = "from drivers.files import video_frames; from pathlib import Path; import sys; "
    read += "video_frames(Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", read, str(file)], capture_output=True, text=True, check=False
    )
    *_, last = done.stderr.splitlines()
    assert "film.avi is no video" in last
    assert "avi @" not in done.stderr and "VIDEOIO" not in done.stderr

"""What is kept of a film's frames is enough to see in them the same, to the last bit."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.plane import PlaneView
from cell.records.recording import form
from cell.records.recording.band import (
    TILE_PX,
    WHOLE_EVERY,
    FilmBand,
    VisionSetup,
    keep_band,
    read_tiles,
    tile_means,
)
from cell.records.recording.film import read_film, read_frame
from cell.records.recording.reading import TornRecordingError, read_recording, shown_image
from cell.records.recording.writer import RecordingSession, RecordingWriter
from cell.vision.detect import VisionOptions, detect
from cell.vision.sighting import Sighting, Unseen
from drivers.sim.render import LIGHT_ON_DARK, RenderOptions, render

Image = np.ndarray
Change = Callable[[Image, int], Image]

VIEW = PlaneView.from_scale(2e-4, 320.0, 256.0)
SMALL = {"width_px": 640, "height_px": 512}


def cable_line(swing: float) -> Image:
    """(401, 2) line of a cable that leaves a level jaw at the plane's (0.015, 0.02), tip first."""
    s = np.linspace(0.0, 0.06, 401)
    angle = (3.0 + swing) * s / 0.06 * (2.0 - s / 0.06) * 0.3
    step = np.gradient(s)
    line = np.stack([-np.cumsum(np.cos(angle) * step), -np.cumsum(np.sin(angle) * step)], axis=1)
    return (line + np.array([0.015, 0.02]))[::-1]


def film(count: int, options: RenderOptions, change: Change | None = None) -> Iterator[Image]:
    """Frames of a cable that swings while its jaw goes down for a while, then rests."""
    for index in range(count):
        down_m = 0.0004 * min(index, 30)
        line = cable_line(0.6 * np.sin(0.25 * index)) - np.array([0.0, down_m])
        pose = (0.015, 0.02 - down_m, 0.0)
        rng = np.random.default_rng(index)
        image = render(line, pose, VIEW.homography, options, rng)
        yield image if change is None else change(image, index)


def seen_in(image: Image, index: int, options: VisionOptions) -> Sighting:
    return detect(image, index / 200.0, VIEW, options)


def values(sighting: Sighting) -> tuple:
    numbers = [sighting.clamp_angle_rad, sighting.quality, sighting.length_m]
    return (
        sighting.nodes_m.tobytes(),
        sighting.grip_m.tobytes(),
        np.array(numbers).tobytes(),
        sighting.unseen,
    )


def shadow(image: Image, index: int) -> Image:
    """The edge of a shadow wanders over the picture."""
    across = np.arange(image.shape[1])[None, :]
    share = 0.75 + 0.25 / (1.0 + np.exp(-(across - 4.0 * index) / 20.0))
    return np.round(image * share).astype(np.uint8)


def flicker(image: Image, index: int) -> Image:
    return np.round(image * (0.95 + 0.05 * np.sin(index))).astype(np.uint8)


def noisy(image: Image, index: int) -> Image:
    noise = np.random.default_rng(1000 + index).normal(0.0, 8.0, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def hidden(image: Image, index: int) -> Image:
    """A gripper comes between for a while."""
    image = image.copy()
    if 20 <= index < 40:
        image[:, 300:420] = 90
    return image


def dark(image: Image, index: int) -> Image:
    return np.zeros_like(image) if index == 25 else image


@pytest.mark.parametrize(
    ("cable_is", "change", "most"),
    [
        ("dark", None, 0.11),
        ("light", None, 0.11),
        ("dark", noisy, 0.15),
        ("dark", shadow, 0.35),
        ("dark", flicker, 1.0),
        ("dark", hidden, 0.20),
        ("dark", dark, 0.20),
    ],
)
def test_vision_finds_the_same_in_what_is_kept(cable_is, change, most) -> None:
    options = VisionOptions(free_length_m=0.06, cable_is=cable_is)
    scene = replace(LIGHT_ON_DARK if cable_is == "light" else RenderOptions(), **SMALL)
    band, shown, pixels, count = FilmBand(VisionSetup(VIEW, options)), None, 0, 60
    found = []
    for index, image in enumerate(film(count, scene, change)):
        sighting = seen_in(image, index, options)
        kept, blank = band.keep(index, index / 200.0, image, last=index == count - 1)
        shown = shown_image(shown, kept, blank)
        assert values(seen_in(shown, index, options)) == values(sighting)
        if blank is None:
            assert np.array_equal(kept, image)
        else:
            assert np.array_equal(kept[kept != blank], image[kept != blank])
            assert 0 < index < count - 1
        pixels += kept.size if blank is None else np.count_nonzero(kept != blank)
        found.append(sighting.unseen)
    assert found.count(None) >= 40
    assert pixels / (count * image.size) < most


def test_one_in_so_many_is_whole() -> None:
    scene = replace(RenderOptions(), **SMALL)
    options = VisionOptions(free_length_m=0.06)
    image = next(film(1, scene))
    band = FilmBand(VisionSetup(VIEW, options))
    whole = []
    for index in range(2 * WHOLE_EVERY):
        if band.keep(index, index / 200.0, image, last=False)[1] is None:
            whole.append(index)
    assert whole == [0, WHOLE_EVERY]


def test_a_band_that_has_all_grey_levels_is_whole() -> None:
    """There is none that could say where nothing is shown."""
    scene = replace(RenderOptions(), **SMALL)
    options = VisionOptions(free_length_m=0.06)
    first, second = film(2, scene)
    band = FilmBand(VisionSetup(VIEW, options))
    band.keep(0, 0.0, first, last=False)
    second = second.copy()
    second[400:416, 100:116] = np.arange(256, dtype=np.uint8).reshape(16, 16)
    kept, blank = band.keep(1, 0.005, second, last=False)
    assert blank is None
    assert np.array_equal(kept, second)


@pytest.mark.parametrize("shape", [(48, 64), (49, 66), (51, 67)])
def test_squares_cover_pictures_of_any_size(shape) -> None:
    image = np.arange(shape[0] * shape[1]).reshape(shape).astype(np.uint8)
    means = tile_means(image)
    assert means.shape == tuple(-(-size // TILE_PX) for size in shape)
    assert means[0, 0] == pytest.approx(image[:4, :4].mean(), abs=0.51)
    nothing = Sighting(
        0.0, np.full((11, 2), np.nan), np.full(2, np.nan), np.nan, 0.0, Unseen.NO_JAW
    )
    setup = VisionSetup(VIEW, VisionOptions(free_length_m=0.06))
    assert not read_tiles(nothing, setup, shape).any()


# --- a file -----------------------------------------------------------------------------------

COUNT = 12


@pytest.fixture(scope="module")
def images() -> list[Image]:
    return list(film(COUNT, replace(RenderOptions(), **SMALL)))


@pytest.fixture(scope="module")
def setup() -> VisionSetup:
    return VisionSetup(VIEW, VisionOptions(free_length_m=0.06))


def write(path: Path, images: list[Image]) -> dict[str, int]:
    """A recording of two films; its messages by topic."""
    writer = RecordingWriter(path, {form.EPOCH: "0", "cycle": "7"})
    for number, image in enumerate(images):
        index = number % (COUNT // 2)
        writer.frame(index, number / 200.0, *image.shape, image.tobytes())
        writer.event(form.STATE, number / 200.0, {"state": "execute", "step": None})
        writer.flush()
    counts = dict(writer.counts)
    writer.close({"complete": "true", "counts": json.dumps(counts)})
    return counts


def test_all_but_the_frames_is_as_it_was(tmp_path, images, setup) -> None:
    source, target = tmp_path / "whole.mcap", tmp_path / "band.mcap"
    counts = write(source, images)
    keep_band(source, target, setup, counts)
    before, after = read_recording(source), read_recording(target)
    assert (after.started, after.closed) == (before.started, before.closed)
    assert list(after.json(form.STATE)) == list(before.json(form.STATE))
    whole = [said["index"] for said in after.json(form.FRAME) if "blank" not in said]
    assert whole == [0, COUNT // 2 - 1] * 2  # first and last of two films
    assert target.stat().st_size < 0.5 * source.stat().st_size
    for frame, image in zip(after.frames(), images, strict=True):
        found = detect(frame.image, frame.t_s, VIEW, setup.options)
        assert values(found) == values(detect(image, frame.t_s, VIEW, setup.options))
    films, numbers = (read_film(source), read_film(target)), (0, 2, COUNT - 2)
    of_both = [[read_frame(one, n).jpeg(640) for n in numbers] for one in films]
    assert of_both[0][0] == of_both[1][0]
    sizes = np.array([[len(jpeg) for jpeg in one] for one in of_both])
    assert np.all(np.abs(np.diff(sizes, axis=0)) < 0.05 * sizes[0])  # noise alone differs


def test_a_file_that_lacks_a_message_is_not_reduced(tmp_path, images, setup) -> None:
    source, target = tmp_path / "whole.mcap", tmp_path / "band.mcap"
    counts = write(source, images)
    with pytest.raises(TornRecordingError, match="is not what was written"):
        keep_band(source, target, setup, counts | {form.STATE: counts[form.STATE] + 1})


def session(folder: Path, images: list[Image], setup: VisionSetup) -> RecordingSession:
    begun = {form.EPOCH: "0", "cycle": "7"}
    made = RecordingSession(folder / form.FILE, begun, vision=pickle.dumps(setup))
    for index, image in enumerate(images):
        made.write(("frame", index, index / 200.0, *image.shape), image.tobytes())
    return made


@pytest.mark.parametrize("whole", [False, True])
def test_whole_frames_stay_too_where_they_are_wanted(tmp_path, images, setup, whole) -> None:
    report = session(tmp_path, images, setup).end(True, True, whole)
    assert report["not_reduced"] == ""
    assert report["bytes"] == (tmp_path / form.FILE).stat().st_size
    names = {form.FILE, form.WHOLE} if whole else {form.FILE}
    assert {p.name for p in tmp_path.iterdir()} == names
    if whole:
        frames = read_recording(tmp_path / form.WHOLE).frames()
        assert all(np.array_equal(f.image, i) for f, i in zip(frames, images, strict=True))


def test_one_that_cannot_be_reduced_stays_whole_and_says_why(tmp_path, images, setup) -> None:
    made = session(tmp_path, images, setup)
    (tmp_path / form.BAND).mkdir()  # nothing can be written there
    report = made.end(True, True)
    assert "recording.mcap.band" in report["not_reduced"]
    frames = read_recording(tmp_path).frames()
    assert all(np.array_equal(f.image, i) for f, i in zip(frames, images, strict=True))


def test_one_of_a_killed_cell_keeps_its_frames_whole(tmp_path, images, setup) -> None:
    """Somebody recovers it, and waits for that."""
    report = session(tmp_path, images, setup).end(True, complete=False)
    assert report["not_reduced"] == ""
    assert all("blank" not in said for said in read_recording(tmp_path).json(form.FRAME))


def test_a_frame_whose_picture_found_no_room_is_kept_as_it_is(tmp_path, images, setup) -> None:
    source, target = tmp_path / "whole.mcap", tmp_path / "band.mcap"
    writer = RecordingWriter(source, {form.EPOCH: "0", "cycle": "7"})
    for index, image in enumerate(images):
        if index == 4:
            writer.event(form.FRAME, index / 200.0, {"index": index, "t_s": index / 200.0})
        else:
            writer.frame(index, index / 200.0, *image.shape, image.tobytes())
    counts = dict(writer.counts)
    writer.close({"complete": "true", "counts": json.dumps(counts)})
    keep_band(source, target, setup, counts)
    assert [f.index for f in read_recording(target).frames()] == [0, 1, 2, 3, *range(5, COUNT)]

"""Instants of a sequence, in videos or folders: reading, selection, and errors in some of them."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image
from scipy.ndimage import binary_dilation

from ghgs_capture import camera_report
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.verbs.photographs import check_cameras
from ghgs_capture.verbs.predict import read_captures
from ghgs_capture.videos import Reader, read_video
from ghgs_lit.errors import InputError
from tests.helpers.captures import truncate
from tests.helpers.sequences import (
    FIGURE,
    FPS,
    FRAMES,
    SIDE,
    alike,
    all_numbers,
    frames_of,
    instants,
    mask,
    number_of,
    numbers,
    opened,
    write_video,
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write four videos with masks, and the calibration."""
    place = tmp_path_factory.mktemp("videos")
    for camera, name in enumerate(FIGURE.names):
        write_video(place / "images" / f"{name}.mp4", frames_of(camera))
        write_video(place / "masks" / f"{name}.mp4", [mask(camera)] * FRAMES)
    shutil.move(FIGURE.write(place / "still"), place / "cameras.json")
    return place


@pytest.fixture
def place(written, tmp_path):
    return shutil.copytree(written, tmp_path / "place")


def test_videos_are_read_in_order(place):
    """Every frame with its mask, in instants named after frames; then the first one again after the last."""
    folder = opened(place)
    assert all_numbers(folder) == {f"{n:06d}": alike(n) for n in range(FRAMES)}
    first = folder.photographs("000000")
    assert numbers(first) == alike(0)
    for camera, photograph in enumerate(first):
        assert photograph.matte.shape == (SIDE, SIDE)
        assert (photograph.mask ^ FIGURE.masks[camera]).mean() < 0.01
        beside = ~binary_dilation(FIGURE.masks[camera], iterations=3)
        assert (photograph.matte[beside] == 0).all()  # coding leaves no haze


@pytest.mark.parametrize("suffix", [".mov", ".mkv", ".avi", ".webm"])
def test_frames_have_their_numbers_in_every_kind_of_file(tmp_path, suffix):
    """Frames are stored in another order than shown, and read from the end to the beginning."""
    options = {"codec": "libvpx"} if suffix == ".webm" else {"codec": "libx264"}
    path = tmp_path / f"a{suffix}"
    write_video(path, frames_of(0), **options)
    video = read_video(path)
    assert (video.count, video.size) == (FRAMES, (SIDE, SIDE))
    assert video.rate == pytest.approx(FPS, rel=0.01)
    reader = Reader(video, "gray")
    for number in [*range(FRAMES), *reversed(range(FRAMES))]:
        assert number_of(reader.frame(number)) == number


def test_frames_that_were_cut_off_do_not_count(tmp_path):
    """A phone that trims a video keeps the earlier frames in its file, marked as not shown."""
    write_video(tmp_path / "whole.mp4", frames_of(0), codec="libx264")
    cut = [get_ffmpeg_exe(), "-v", "error", "-ss", "0.15", "-i", tmp_path / "whole.mp4"]
    subprocess.run([*cut, "-c", "copy", tmp_path / "cut.mp4"], check=True)
    video = read_video(tmp_path / "cut.mp4")
    reader = Reader(video, "gray")
    assert [number_of(reader.frame(n)) for n in range(video.count)] == list(range(2, FRAMES))


def test_a_long_video_is_sought(tmp_path):
    """Also if only one frame of many is decoded at a time."""
    rng = np.random.default_rng(0)
    order = rng.permutation(400) % 7
    write_video(tmp_path / "a.mp4", (np.full((16, 16, 3), 30 * n, np.uint8) for n in order), fps=20)
    video = read_video(tmp_path / "a.mp4")
    for step, wanted in ((1, (350, 20, 21, 399, 0)), (25, (50, 75, 325, 350, 0))):
        reader = Reader(video, "gray", step)
        assert [round(float(reader.frame(n).mean()) / 30) for n in wanted] == [order[n] for n in wanted]


def test_a_frame_that_a_camera_dropped_shifts_no_other(place):
    """The instant of the dropped frame is predicted from the other three."""
    keep = ["-vf", "select=not(eq(n\\,2))", "-fps_mode", "passthrough"]
    write_video(place / "images" / "cam1.mp4", frames_of(1), output_params=keep)
    found = all_numbers(opened(place))
    assert found == {
        f"{n:06d}": alike(n, [name for name in FIGURE.names if n != 2 or name != "cam1"])
        for n in range(FRAMES)
    }


def test_masks_of_the_frames_that_there_are(place):
    """Masks made frame by frame do not count dropped frames: masks of other frames are not used."""
    keep = ["-vf", "select=not(eq(n\\,2))", "-fps_mode", "passthrough"]
    write_video(place / "images" / "cam1.mp4", frames_of(1), output_params=keep)
    drawn = [np.roll(mask(1), 2 * number, 0) for number in range(FRAMES)]
    write_video(place / "masks" / "cam1.mp4", drawn[:2] + drawn[3:])
    for number in (1, 3, 5):
        found = {p.name: p.mask for p in opened(place).photographs(f"{number:06d}")}
        assert (found["cam1"] ^ (drawn[number] > 127)).mean() < 0.01


def test_videos_of_different_length(place, capsys):
    write_video(place / "images" / "cam2.mp4", frames_of(2, 4))
    with pytest.warns(UserWarning, match="videos differ in length: 4 instants of frames .*'cam2': 4"):
        folder = opened(place)
    assert list(all_numbers(folder)) == ["000000", "000001", "000002", "000003"]


def test_another_size_of_a_mask_video(place, capsys):
    write_video(place / "masks" / "cam1.mp4", [mask(1)[:48]] * FRAMES)
    assert all_numbers(opened(place))["000003"] == alike(3, ["cam0", "cam2", "cam3"])
    assert "instant 000003 is without cam1: " in capsys.readouterr().out


def with_curve(number):
    def tag(path):
        tags = ["-c", "copy", "-bsf:v", f"h264_metadata=transfer_characteristics={number}"]
        subprocess.run(
            [get_ffmpeg_exe(), "-v", "error", "-i", path, *tags, path.with_name("hdr.mp4")], check=True
        )
        path.with_name("hdr.mp4").rename(path)

    return tag


# Damage to the video of cam1, the part of the sequence, and the message about it.
REFUSED = {
    "another size": (
        lambda path: write_video(path, (frame[:48] for frame in frames_of(1))),
        {},
        r"cam1\.mp4: .*cam1.*64x64.*found 48x64",
    ),
    "HLG": (with_curve(18), {}, r"cam1\.mp4: expected colours of standard range .*; found 'HLG'"),
    "PQ": (with_curve(16), {}, r"cam1\.mp4: expected colours of standard range .*; found 'PQ'"),
    "another rate": (
        lambda path: write_video(path, frames_of(1), fps=15),
        {},
        r"sequence\.sync: expected as many frames a second .*found .*'cam1': 15\.0, 'cam2': 10\.0",
    ),
    "no video": (
        lambda path: path.write_bytes(b"no video" * 100),
        {},
        r"cam1\.mp4: expected a video with frames that ffmpeg can decode; found",
    ),
    "offsets of unknown cameras": (
        None,
        {"sync": {"cam9": 1}},
        r"sequence\.sync: .*cam0, cam1.*found \['cam9'\]",
    ),
    "offsets of half frames": (None, {"sync": {"cam1": 0.5}}, r"sequence\.sync: .*whole numbers of frames"),
    "offsets beyond the videos": (
        None,
        {"sync": {"cam1": 6}},
        r"sequence\.sync: .*frames that all videos show",
    ),
    "nothing after the end": (None, {"start": 6}, r"sequence\.start: expected a part of 6 instants; found"),
    "nothing before the start": (None, {"start": 3, "stop": 2}, "from 3 to 2"),
    "no step": (None, {"step": 0}, r"sequence\.step: expected an integer >= 1; found 0"),
    "no such key": (None, {"skip": 1}, "sequence.skip: expected one of .*found 'skip'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_sequences_that_are_refused(place, name):
    spoil, part, line = REFUSED[name]
    if spoil is not None:
        spoil(place / "images" / "cam1.mp4")
    with pytest.raises(InputError, match=line):
        opened(place, sequence=part)


def test_a_broken_frame(place, capsys):
    """In a video with independent frames, only the damaged one is left out."""
    path = place / "images" / "cam1.avi"
    (place / "images" / "cam1.mp4").unlink()
    write_video(path, frames_of(1), codec="mjpeg")
    content = bytearray(path.read_bytes())
    starts = [i for i in range(len(content)) if content[i : i + 3] == b"\xff\xd8\xff"]
    content[starts[2] : starts[3] - 8] = bytes(starts[3] - 8 - starts[2])
    path.write_bytes(content)
    found = all_numbers(opened(place))
    assert found["000002"] == alike(2, ["cam0", "cam2", "cam3"])
    assert [found[f"{n:06d}"] for n in (0, 1, 3, 4, 5)] == [alike(n) for n in (0, 1, 3, 4, 5)]
    assert "instant 000002 is without cam1: " in capsys.readouterr().out


def test_empty_masks_for_a_while(place, capsys):
    """For one camera, the others are used; for two, only these instants are left out."""
    for camera, name, last in ((0, "cam0", 1), (1, "cam1", 2)):
        masks = [mask(camera) * (not 1 <= number <= last) for number in range(FRAMES)]
        write_video(place / "masks" / f"{name}.mp4", masks)
    found = all_numbers(opened(place))
    assert found == {"000000": alike(0), "000002": alike(2, ["cam0", "cam2", "cam3"])} | {
        f"{n:06d}": alike(n) for n in (3, 4, 5)
    }
    out = capsys.readouterr().out
    assert out.count("\n") == 2
    assert "instant 000001 is left out: " in out
    assert "3 photographs or more; found '2 (cam0: " in out
    assert "instant 000002 is without cam1: " in out
    assert "found 0 pixels" in out


def test_masks_beside_videos_count_where_nothing_else_is_said(place):
    """Also next to photographs; a given background takes precedence."""
    for camera, name in enumerate(FIGURE.names):
        shutil.move(place / "masks" / f"{name}.mp4", place / "images" / f"{name}_mask.mp4")
        (place / "backgrounds").mkdir(exist_ok=True)
        background = FIGURE.images[camera].copy()
        background[FIGURE.masks[camera]] += np.uint8(128)
        background[:16] += np.uint8(128)
        Image.fromarray(background).save(place / "backgrounds" / f"{name}.png")
    for camera, photograph in enumerate(opened(place, masks=None).photographs("000003")):
        assert (photograph.mask ^ FIGURE.masks[camera]).mean() < 0.01
    other = opened(place, masks=None, backgrounds=place / "backgrounds").photographs("000003")
    assert all(photograph.mask[:12, 16:].mean() > 0.9 for photograph in other)


def test_offsets(place):
    """A camera that started two frames before the others is two frames ahead."""
    found = all_numbers(opened(place, sequence={"sync": {"cam1": 2}}))
    assert found == {f"{n:06d}": alike(n) | {"cam1": n + 2} for n in range(4)}
    found = all_numbers(opened(place, sequence={"sync": {"cam1": -2, "cam2": 1}}))
    assert found == {f"{n:06d}": alike(n) | {"cam1": n - 2, "cam2": n + 1} for n in (2, 3, 4)}


def test_videos_without_ffmpeg(place, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(
        InputError, match=r"expected the package imageio_ffmpeg .*ghgs-lit\[video\].*found none"
    ):
        opened(place)


@pytest.mark.parametrize(
    ("part", "chosen"),
    [
        ({"start": 1, "stop": 5, "step": 2}, (1, 3)),
        ({"start": -2}, (4, 5)),
        ({"step": 5}, (0, 5)),
        ({"stop": -4}, (0, 1)),
    ],
)
@pytest.mark.parametrize("kind", ["videos", "instants"])
def test_a_part_of_a_sequence(place, part, chosen, kind):
    folder = opened(place, sequence=part) if kind == "videos" else None
    folder = folder or CaptureFolder(instants(place), place / "cameras.json", sequence=part)
    assert [set(found.values()) for found in all_numbers(folder).values()] == [{n} for n in chosen]
    assert [int(name) for name in folder.instants] == list(chosen)


def test_a_single_instant_of_a_sequence_is_refused_as_one(place):
    folder = instants(place)
    truncate(folder / "002" / "cam1.png")
    one = CaptureFolder(folder, place / "cameras.json", sequence={"start": 2, "stop": 3})
    with pytest.raises(InputError, match=r"cam1\.png: expected a readable image"):
        list(read_captures(one))


def test_a_photograph_missing_in_a_folder_of_cameras(place):
    folder = instants(place)
    for name in FIGURE.names:
        (place / "by_camera" / name).mkdir(parents=True)
        for instant in sorted(folder.iterdir()):
            shutil.copy(instant / f"{name}.png", place / "by_camera" / name / f"{instant.name}.png")
    for camera, name in enumerate(FIGURE.names):
        for number in range(FRAMES):
            path = place / "still_masks" / name / f"{number:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(FIGURE.masks[camera]).save(path)
    (place / "by_camera" / "cam0" / "000.png").unlink()
    found = all_numbers(opened(place, "by_camera", "still_masks"))
    assert found["000"] == alike(0, ["cam1", "cam2", "cam3"])
    assert found["001"] == alike(1)


def test_instants_and_their_numbers_are_in_order_without_zeros_before(place):
    folder = place / "counted"
    for number in (10, 9, 1):
        for camera, name in enumerate(FIGURE.names):
            (folder / f"frame{number}").mkdir(parents=True, exist_ok=True)
            (place / "by_camera" / name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(FIGURE.images[camera]).save(folder / f"frame{number}" / f"{name}.png")
            shutil.copy(
                folder / f"frame{number}" / f"{name}.png", place / "by_camera" / name / f"frame{number}.png"
            )
    for images in ("counted", "by_camera"):
        assert opened(place, images).instants == ["frame1", "frame9", "frame10"]


def test_photographs_are_not_synchronised(place):
    with pytest.raises(InputError, match=r"sequence\.sync: expected null for photographs"):
        CaptureFolder(instants(place, 2), place / "cameras.json", sequence={"sync": {"cam0": 1}})


def test_cameras_are_refused_where_no_instant_agrees(place, capsys):
    """Cameras that are exchanged in the first three instants, which a later one contradicts."""
    for folder, frames in (("images", frames_of), ("masks", lambda camera: [mask(camera)] * FRAMES)):
        one, other = ([*frames(camera)] for camera in (0, 1))
        write_video(place / folder / "cam0.mp4", other[:3] + one[3:])
        write_video(place / folder / "cam1.mp4", one[:3] + other[3:])
    check_cameras(opened(place))
    assert "cameras and masks agree" in capsys.readouterr().out
    with pytest.raises(InputError, match=r"\{cam0: cam1, cam1: cam0\}"):
        check_cameras(opened(place, sequence={"stop": 2}))


def test_cameras_that_no_instant_can_check_are_said(place, capsys, monkeypatch):
    def unreadable(*_):
        raise InputError("broken")

    monkeypatch.setattr(camera_report, "diagnose", unreadable)
    check_cameras(opened(place))
    assert "cameras are not checked: none of the instants" in capsys.readouterr().out

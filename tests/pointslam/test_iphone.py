"""ScanNet++'s iPhone recordings, published and extracted, written small, are read."""

from __future__ import annotations

import json
import struct
import sys
import zlib

import cv2
import lz4.block
import numpy as np
import pytest

from pointslam.datasets import FileSequence, open_sequence
from pointslam.datasets.iphone_depth import open_depth
from pointslam.datasets.video import Video
from shared import se3
from shared.errors import SequenceError
from shared.frames import Frame
from shared.rectify import rectify

NUM_FRAMES = 70  # beyond two bookmarks of a deflate stream


def truth(sequence: FileSequence, index: int) -> se3.Matrix:
    T_world_camera = sequence.truth(index)
    assert T_world_camera is not None
    return T_world_camera


def depth_mm(number: int) -> np.ndarray:
    return np.full((192, 256), 1000 + number, np.uint16)


def deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(1, wbits=-zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def metres(number: int) -> bytes:
    return (depth_mm(number) / 1000.0).astype("<f4").tobytes()


def one_stream(count: int) -> bytes:
    return deflate(b"".join(metres(i) for i in range(count)))


def sized(blocks: list[bytes]) -> bytes:
    return b"".join(struct.pack("<I", len(block)) + block for block in blocks)


def sized_deflate(count: int) -> bytes:
    return sized([deflate(metres(i)) for i in range(count)])


def sized_lz4(count: int) -> bytes:
    images = [depth_mm(i).tobytes() for i in range(count)]
    return sized([lz4.block.compress(image, store_size=False) for image in images])


LAYOUTS = [one_stream, sized_deflate, sized_lz4]


def write_poses(root, count: int) -> None:
    records = {}
    for i in range(count):
        pose = np.eye(4)
        pose[0, 3] = i
        records[f"frame_{i:06d}"] = {
            "timestamp": 3.5 + i / 60,
            "pose": pose.tolist(),
            "aligned_pose": pose.tolist(),
            "intrinsic": [[150.0 + i, 0, 80], [0, 150.0 + i, 60], [0, 0, 1]],
        }
    root.mkdir(parents=True, exist_ok=True)
    (root / "pose_intrinsic_imu.json").write_text(json.dumps(records))


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    """`rgb.mkv` whose frame i is grey of level 30 + 3 i."""
    path = tmp_path_factory.mktemp("video") / "rgb.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 60.0, (160, 120))
    for i in range(NUM_FRAMES):
        writer.write(np.full((120, 160, 3), 30 + 3 * i, np.uint8))
    writer.release()
    return path


@pytest.fixture
def published(tmp_path, video):
    """An iPhone recording as it is downloaded; one more pose than there are images."""
    root = tmp_path / "8b5caf3398/iphone"
    write_poses(root, NUM_FRAMES + 1)
    (root / "rgb.mkv").write_bytes(video.read_bytes())
    (root / "depth.bin").write_bytes(sized_lz4(NUM_FRAMES))
    return root


def level(image: np.ndarray) -> int:
    """Number of a video's frame, which lossy coding leaves readable."""
    return round((float(image[..., 1].mean()) - 30) / 3)  # green is the luma's best share


def test_a_published_iphone_recording_needs_no_extraction(published):
    sequence = open_sequence(published.parent)

    frame = sequence.frame(3)
    image = rectify(Frame(0, 0, frame.rgb, frame.depth), sequence.calibration)

    assert len(sequence) == NUM_FRAMES
    assert sequence.stamp(3) == "3.550000"
    assert truth(sequence, 3)[0, 3] == 3.0
    assert level(image.rgb) == 3
    assert image.depth_m[60, 80] == pytest.approx(1.003)


def test_published_depth_is_a_camera_of_256x192(published):
    depth = open_sequence(published).calibration.depth_camera().intrinsics

    assert (depth.width, depth.height) == (256, 192)


def test_a_frame_of_the_video_is_the_same_in_any_order(video):
    film = Video(video)

    levels = [level(film.frame(i)) for i in (0, 1, 2, 69, 5, 4, 30)]

    assert levels == [0, 1, 2, 69, 5, 4, 30]


def test_a_video_that_ends_early_has_fewer_frames(published):
    data = (published / "rgb.mkv").read_bytes()
    (published / "rgb.mkv").write_bytes(data[: len(data) // 2])

    sequence = open_sequence(published)

    assert 0 < len(sequence) < NUM_FRAMES
    assert sequence.frame(len(sequence) - 1).rgb.bytes


def test_a_damaged_video_is_named(published):
    (published / "rgb.mkv").write_bytes(b"no video" * 100)

    with pytest.raises(SequenceError, match=r"rgb\.mkv: is no video"):
        open_sequence(published)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_depth_of_every_published_layout_is_read_in_any_order(tmp_path, layout):
    file = tmp_path / "depth.bin"
    file.write_bytes(layout(NUM_FRAMES))

    depth = open_depth(file)

    assert len(depth) == NUM_FRAMES
    for number in (0, 1, 69, 40, 41, 31, 32, 0):
        np.testing.assert_array_equal(depth.frame_mm(number), depth_mm(number))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_truncated_depth_is_refused(tmp_path, layout):
    file = tmp_path / "depth.bin"
    file.write_bytes(layout(4)[:-40])

    with pytest.raises(SequenceError, match=r"depth\.bin"):
        open_depth(file)


def test_depth_that_is_no_number_is_no_depth(tmp_path):
    image = np.array([np.nan, np.inf, -1.0, 70.0, 1.5], "<f4")
    file = tmp_path / "depth.bin"
    file.write_bytes(deflate(np.resize(image, (192, 256)).astype("<f4").tobytes()))

    first = open_depth(file).frame_mm(0)[0, :5]

    np.testing.assert_array_equal(first, [0, 0, 0, 0, 1500])


def test_lz4_that_is_not_installed_is_told_with_its_command(published, monkeypatch):
    monkeypatch.setitem(sys.modules, "lz4.block", None)

    with pytest.raises(SequenceError, match="pip install lz4"):
        open_sequence(published)


def test_an_iphone_folder_without_images_is_refused(published):
    (published / "depth.bin").unlink()

    with pytest.raises(SequenceError, match=r"neither rgb\.mkv and depth\.bin"):
        open_sequence(published)


@pytest.fixture
def extracted(tmp_path, write_images):
    """An iPhone recording after the toolkit has extracted it."""
    root = tmp_path / "8b5caf3398/iphone"
    write_poses(root, 3)
    for i in range(3):
        name = f"frame_{i:06d}"
        write_images(root / f"rgb/{name}.jpg", root / f"depth/{name}.png", (160, 120), (32, 24))
    return root


def test_extracted_depth_is_a_camera_of_its_own_resolution(extracted):
    sequence = open_sequence(extracted.parent)

    assert sequence.calibration.colour.intrinsics.fx == 151.0  # the median
    assert sequence.calibration.depth_camera().intrinsics.width == 32
    assert sequence.calibration.depth_camera().intrinsics.fx == pytest.approx(151.0 / 5)
    assert truth(sequence, 2)[0, 3] == 2.0

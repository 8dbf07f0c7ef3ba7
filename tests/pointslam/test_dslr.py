"""ScanNet++'s DSLR recordings, written small, are read with poses and lenses."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from pointslam.datasets import FileSequence, open_sequence
from shared import se3
from shared.errors import SequenceError
from shared.frames import Frame
from shared.images import decode_depth
from shared.rectify import rectify

LENS = (60.0, 60.0, 48.0, 32.0, 0.01, 0.0, 0.0, 0.0)
TURN = np.array([0.5, 0.5, 0.5, 0.5])  # a quaternion, w first: x to y to z


def truth(sequence: FileSequence, index: int) -> se3.Matrix:
    T_world_camera = sequence.truth(index)
    assert T_world_camera is not None
    return T_world_camera


@pytest.fixture
def dslr(tmp_path, write_images):
    root = tmp_path / "b20a261fdf/dslr"
    names = ["DSC00003.JPG", "DSC00001.JPG", "DSC00002.JPG"]
    for name in names:
        depth = root / "render_depth" / f"{name[:-4]}.png"
        write_images(root / "resized_images" / name, depth, (96, 64))
    frames = [{"file_path": n, "transform_matrix": np.eye(4).tolist()} for n in names]
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")
    lens = dict(zip(keys, LENS, strict=True)) | {"w": 96, "h": 64, "camera_model": "OPENCV_FISHEYE"}
    transforms = lens | {"frames": frames[:2], "test_frames": frames[2:]}
    (root / "nerfstudio").mkdir()
    (root / "nerfstudio/transforms.json").write_text(json.dumps(transforms))
    lists = {"train": names[:2], "test": names[2:]}
    (root / "train_test_lists.json").write_text(json.dumps(lists))
    return root


def test_dslr_train_list_is_the_sequence_in_its_order(dslr):
    sequence = open_sequence(dslr.parent)

    assert [f.rgb.name for f in sequence.frames] == ["DSC00003.JPG", "DSC00001.JPG"]
    assert sequence.calibration.colour.fisheye
    assert sequence.calibration.colour.intrinsics.cx == 47.5


def test_dslr_test_list_are_views_off_the_trajectory(dslr):
    sequence = open_sequence(dslr)

    assert sequence.num_views == 1
    assert sequence.view(0).depth is not None


def test_dslr_poses_look_along_the_optical_axis(dslr):
    T = truth(open_sequence(dslr), 0)

    np.testing.assert_allclose(se3.rotate(T, np.array([[0.0, 0.0, 1.0]])), [[0, 0, -1]])


def test_dslr_without_rendered_depth_says_so(dslr):
    for image in (dslr / "render_depth").iterdir():
        image.unlink()

    with pytest.raises(SequenceError, match="render_depth"):
        open_sequence(dslr)


def colmap_text(folder) -> None:
    lens = " ".join(map(str, LENS))
    (folder / "cameras.txt").write_text(f"# cameras\n1 OPENCV_FISHEYE 96 64 {lens}\n")
    quaternion = " ".join(map(str, TURN))
    images = [f"{i} {quaternion} 1 2 3 1 DSC0000{i}.JPG\n" for i in (1, 2, 3)]
    points = ["5.5 6.5 -1 7.5 8.5 12\n", "\n", "5.5 6.5 -1\n"]  # the second sees none
    lines = [text for pair in zip(images, points, strict=True) for text in pair]
    (folder / "images.txt").write_text("# images\n" + "".join(lines))


def colmap_binary(folder) -> None:
    camera = struct.pack("<QIiQQ8d", 1, 1, 5, 96, 64, *LENS)
    (folder / "cameras.bin").write_bytes(camera)
    data = struct.pack("<Q", 3)
    for i in (1, 2, 3):
        data += struct.pack("<I7dI", i, *TURN, 1.0, 2.0, 3.0, 1) + f"DSC0000{i}.JPG".encode()
        data += b"\0" + struct.pack("<Q", i) + i * struct.pack("<ddq", 5.5, 6.5, -1)
    (folder / "images.bin").write_bytes(data)


@pytest.fixture(params=[colmap_text, colmap_binary])
def colmap_dslr(dslr, request):
    """A DSLR recording that has its COLMAP model only."""
    (dslr / "nerfstudio/transforms.json").unlink()
    (dslr / "colmap").mkdir()
    request.param(dslr / "colmap")
    return dslr


def test_colmap_gives_the_fisheye_lens_where_there_are_no_transforms(dslr, colmap_dslr):
    camera = open_sequence(colmap_dslr).calibration.colour

    assert camera.fisheye
    assert camera.distortion == LENS[4:]
    assert (camera.intrinsics.fx, camera.intrinsics.cx, camera.intrinsics.width) == (60, 47.5, 96)


def test_colmap_poses_are_inverted_to_camera_to_world(colmap_dslr):
    T = se3.inverse(truth(open_sequence(colmap_dslr), 0))

    np.testing.assert_allclose(T[:3, 3], [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_colmap_model_of_an_unknown_lens_is_named(dslr):
    (dslr / "nerfstudio/transforms.json").unlink()
    (dslr / "colmap").mkdir()
    colmap_text(dslr / "colmap")
    (dslr / "colmap/cameras.txt").write_text("1 FOV 96 64 60 60 48 32 0.9\n")

    with pytest.raises(SequenceError, match=r"cameras\.txt: .* FOV is unknown"):
        open_sequence(dslr)


def test_dslr_without_any_poses_names_the_file(dslr):
    (dslr / "nerfstudio/transforms.json").unlink()

    with pytest.raises(SequenceError, match=r"transforms\.json"):
        open_sequence(dslr)


def test_fisheye_pictures_come_out_as_a_pinhole(dslr):
    sequence = open_sequence(dslr)
    frame = sequence.frame(0)

    image = rectify(Frame(0, 0, frame.rgb, frame.depth), sequence.calibration)

    raw = decode_depth(frame.depth, sequence.calibration)
    assert raw[32, 48] == image.depth_m[32, 48] == 1.0
    assert image.rgb.shape == (64, 96, 3)

"""Sequences of every published layout, written small, are read with stamps, poses, calibration."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pointslam.datasets import FileSequence, SequenceOptions, is_held_out, open_sequence
from pointslam.datasets.lists import associate
from shared import se3
from shared.errors import SequenceError
from shared.frames import ColourEncoding, Frame
from shared.rectify import rectify

SIZE = (640, 480)


def truth(sequence: FileSequence, index: int) -> se3.Matrix:
    T_world_camera = sequence.truth(index)
    assert T_world_camera is not None
    return T_world_camera


@pytest.fixture
def tum(tmp_path, write_images):
    """Four colour frames; depth 5 ms later, one far off; truth at other stamps and unpadded."""
    root = tmp_path / "rgbd_dataset_freiburg2_xyz"
    stamps = [9.9, 10.0, 10.1, 10.2]
    late = [9.905, 10.005, 10.15, 10.205]
    for i, (colour, depth) in enumerate(zip(stamps, late, strict=True)):
        names = root / f"rgb/{colour:.6f}.png", root / f"depth/{depth:.6f}.png"
        write_images(*names, SIZE, level=1000 + i)
    header = "# color images\n# file: 'x.bag'\n# timestamp filename\n"
    (root / "rgb.txt").write_text(header + "".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in stamps))
    (root / "depth.txt").write_text(header + "".join(f"{t:.6f} depth/{t:.6f}.png\n" for t in late))
    (root / "groundtruth.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n9.9100 1 0 0 0 0 0 1\n10.0010 2 0 0 0 0 0 1\n"
    )
    return root


def test_tum_joins_lists_by_the_nearest_stamps(tum):
    sequence = open_sequence(tum)

    assert [f.stamp for f in sequence.frames] == ["9.900000", "10.000000", "10.200000"]
    assert [f.depth.name for f in sequence.frames if f.depth] == [
        "9.905000.png",
        "10.005000.png",
        "10.205000.png",
    ]


def test_tum_frames_without_truth_nearby_have_none(tum):
    sequence = open_sequence(tum)

    assert truth(sequence, 0)[0, 3] == 1.0
    assert truth(sequence, 1)[0, 3] == 2.0
    assert sequence.truth(2) is None


def test_tum_calibration_comes_from_the_folders_name(tum):
    calibration = open_sequence(tum).calibration

    assert calibration.colour.intrinsics.fx == 520.908620
    assert calibration.colour.distortion[0] == 0.231222
    assert calibration.depth_scale == 5000.0


def test_fr2s_other_depth_factor_is_an_option(tum):
    sequence = open_sequence(tum, SequenceOptions(depth_scale=5208.0))

    assert sequence.calibration.depth_scale == 5208.0


def test_tum_without_truth_is_still_a_sequence(tum):
    (tum / "groundtruth.txt").unlink()

    assert open_sequence(tum).truth(0) is None


def test_image_bytes_pass_through_untouched(tum):
    frame = open_sequence(tum).frame(1)

    assert frame.rgb.encoding is ColourEncoding.PNG
    assert frame.rgb.bytes == (tum / "rgb/10.000000.png").read_bytes()
    assert frame.depth.bytes == (tum / "depth/10.005000.png").read_bytes()


def test_tum_folder_of_an_unknown_camera_is_refused(tum):
    other = tum.rename(tum.with_name("my_recording"))

    with pytest.raises(SequenceError, match="freiburg1.*calibration.json"):
        open_sequence(other)


@pytest.fixture
def replica(tmp_path, write_images):
    root = tmp_path / "Replica"
    for i in range(3):
        names = [root / f"room0/results/{kind}{i:06d}" for kind in ("frame", "depth")]
        write_images(names[0].with_suffix(".jpg"), names[1].with_suffix(".png"))
    camera = {"w": 64, "h": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "scale": 6553.5}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    pose = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1\n"
    (root / "room0/traj.txt").write_text("".join(pose.format(i) for i in range(3)))
    return root / "room0"


def test_replica_reads_poses_and_the_cameras_scale(replica):
    sequence = open_sequence(replica)

    assert len(sequence) == 3
    assert sequence.calibration.depth_scale == 6553.5
    assert truth(sequence, 2)[0, 3] == 2.0
    assert sequence.rate_hz == pytest.approx(30.0)


def test_replica_with_too_few_poses_names_the_file(replica):
    (replica / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")

    with pytest.raises(SequenceError, match="traj.txt: 1 poses for 3 frames"):
        open_sequence(replica)


@pytest.fixture
def seven_scenes(tmp_path, write_images):
    root = tmp_path / "chess/seq-01"
    for i in range(2):
        stem = root / f"frame-{i:06d}"
        write_images(
            stem.with_suffix(".color.png"), stem.with_suffix(".depth.png"), SIZE, level=65535
        )
        rows = "1.0\t 0.0\t 0.0\t {}\t\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
        stem.with_suffix(".pose.txt").write_text(rows.format(i))
    return root


def test_seven_scenes_poses_are_moved_to_the_colour_camera(seven_scenes):
    sequence = open_sequence(seven_scenes)
    T_colour_depth = sequence.calibration.T_colour_depth

    T_world_depth = truth(sequence, 1) @ T_colour_depth

    np.testing.assert_allclose(T_world_depth[:3, 3], [1.0, 0.0, 0.0], atol=1e-12)
    assert sequence.calibration.depth_camera().intrinsics.fx == 585.0


def test_seven_scenes_invalid_depth_is_no_depth(seven_scenes):
    sequence = open_sequence(seven_scenes)
    frame = sequence.frame(0)

    image = rectify(Frame(0, 0, frame.rgb, frame.depth), sequence.calibration)

    assert not image.depth_m.any()


@pytest.fixture
def folder(tmp_path, write_images):
    """Two frames whose unpadded names sort in the wrong order, and one novel view."""
    root = tmp_path / "mine"
    for stamp in ("9.5", "10.5"):
        write_images(root / f"rgb/{stamp}.jpg", root / f"depth/{stamp}.png")
    write_images(root / "novel/rgb/1000.0.jpg", root / "novel/depth/1000.0.png")
    for kind, suffix in (("rgb", "jpg"), ("depth", "png")):
        lines = [f"{t} {kind}/{t}.{suffix}\n" for t in ("9.5", "10.5")]
        (root / f"{kind}.txt").write_text("# timestamp filename\n" + "".join(lines))
    (root / "novel/groundtruth.txt").write_text("1000.0 5 0 0 0 0 0 1\n")
    fields = {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}
    fields |= {"distortion": "none", "depth_scale": 1000}
    (root / "calibration.json").write_text(json.dumps(fields))
    return root


def test_frames_are_ordered_by_stamps_not_by_names(folder):
    assert [f.stamp for f in open_sequence(folder).frames] == ["9.5", "10.5"]


def test_views_off_the_trajectory_are_read_with_their_poses(folder):
    view = open_sequence(folder).view(0)

    assert view.T_world_camera[0, 3] == 5.0
    assert view.t_ns == 1000 * 10**9


def test_a_listed_file_that_is_absent_is_named(folder):
    (folder / "rgb/10.5.jpg").unlink()

    with pytest.raises(SequenceError, match=r"rgb/10\.5\.jpg: is listed but absent"):
        open_sequence(folder)


def test_a_bad_line_is_named_by_number(folder):
    (folder / "rgb.txt").write_text("# timestamp filename\nlater rgb/9.5.jpg\n")

    with pytest.raises(SequenceError, match="rgb.txt: line 2: 'later'"):
        open_sequence(folder)


def test_depth_of_another_size_is_refused_before_the_run(folder, write_images):
    write_images(folder / "rgb/9.5.jpg", folder / "depth/9.5.png", depth_size=(32, 24))

    with pytest.raises(SequenceError, match=r"depth/9\.5\.png: is 32x24.*64x48"):
        open_sequence(folder)


def test_a_truncated_image_is_named(folder):
    image = folder / "rgb/9.5.jpg"
    image.write_bytes(image.read_bytes()[:200])

    with pytest.raises(SequenceError, match=r"rgb/9\.5\.jpg"):
        open_sequence(folder)


def test_a_calibration_without_a_field_is_named(folder):
    (folder / "calibration.json").write_text('{"width": 64}')

    with pytest.raises(SequenceError, match="calibration.json"):
        open_sequence(folder)


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_a_folder_of_no_format_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()

    with pytest.raises(SequenceError, match=name):
        open_sequence(tmp_path / name)


def test_every_eighth_frame_is_held_out_from_the_middle():
    assert [i for i in range(20) if is_held_out(i, 8)] == [4, 12]
    assert not any(is_held_out(i, 0) for i in range(20))


def test_association_prefers_the_closest_pair():
    assert associate([0, 100], [90, 96], 100) == [(0, 0), (1, 1)]


def test_kitchens_raw_depth_covers_its_first_frames(data_folder):
    sequence = open_sequence(data_folder / "kitchen-real", SequenceOptions(raw_depth=True))

    assert len(sequence) == 50
    assert sequence.calibration.depth_camera().intrinsics.fx == 585.0

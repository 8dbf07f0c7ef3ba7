"""What moves otherwise than the map is in a keyframe's images, and not in the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from services.mapping.config import LossConfig, MappingConfig
from services.mapping.losses.cpu import mapping_loss_cpu
from services.mapping.losses.mapping_loss import Appearance, Target, mapping_loss
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.rasterizer import Rendered
from services.mapping.storage.entries import check_entry
from services.mapping.views.guessed_depth import look_through
from shared import codec, se3
from shared.errors import InputError
from shared.frames import DepthEncoding
from shared.images import encode_depth, encode_jpeg
from shared.maps import RenderRequest
from shared.pixel_cells import cells_of, pixels_of
from shared.rectify import RgbdImage, rectify
from shared.tracks import Advance, KeyframePoses

ROWS, COLUMNS = slice(24, 56), slice(24, 72)  # of the mask
BOARD = slice(32, 48), slice(32, 64)  # a JPEG's blocks end inside the mask
RED, GREEN = (255, 0, 0), (0, 255, 0)


@pytest.fixture
def moving() -> np.ndarray:
    mask = np.zeros((72, 96), bool)
    mask[ROWS, COLUMNS] = True
    return mask


@pytest.fixture
def behind_board(frame, calibration):
    """A frame with a board before the camera."""

    def make(seq: int, colour: tuple[int, int, int] = RED, depth_mm: int = 800):
        image = rectify(frame(seq), calibration)
        rgb, depth = image.rgb.copy(), (1000 * image.depth_m).round().astype(np.uint16)
        rgb[BOARD], depth[BOARD] = colour, depth_mm
        return replace(
            frame(seq),
            rgb=encode_jpeg(rgb, 98),
            depth=encode_depth(depth, DepthEncoding.RAW16),
        )

    return make


@pytest.fixture
def mapped(calibration, true_pose, behind_board, moving):
    """The map of a few keyframes behind a board."""

    def run(seqs: tuple[int, ...], **board) -> Mapper:
        mapper = Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))
        for i in range(len(seqs)):
            known = np.array(seqs[: i + 1])
            poses = KeyframePoses(i + 1, known, np.stack([true_pose(s) for s in known]))
            images, none = behind_board(seqs[i], **board), np.zeros((0, 3))
            mapper.insert_keyframe(NewKeyframe(images, poses, none, cells_of(moving)))
            mapper.iterate(8)
        return mapper

    return run


def test_a_board_that_goes_with_the_camera_has_no_anchors(mapped):
    mapper = mapped((0, 24))

    depths = mapper.anchors.rows["position"].numpy()[:, 2]
    assert depths.min() > 1.5


def test_the_view_from_the_side_shows_the_wall_behind_the_board(mapped, true_pose, calibration):
    mapper = mapped((0, 24))

    reply = mapper.render(RenderRequest(true_pose(12), calibration.colour.intrinsics))

    drawn = reply.alpha > 200
    assert drawn.mean() > 0.7
    assert reply.depth_m[drawn].min() > 1.5
    red, green, _ = np.moveaxis(reply.rgb.astype(int), -1, 0)
    assert not (red > green + 170)[drawn].any()


def test_what_is_behind_a_board_that_only_one_keyframe_saw_is_not_guessed(
    mapped, true_pose, calibration, moving
):
    mapper = mapped((0,))

    points = se3.transform(se3.inverse(true_pose(0)), mapper.anchors.rows["position"].numpy())
    i = calibration.colour.intrinsics
    u = np.round(points[:, 0] / points[:, 2] * i.fx + i.cx).astype(int).clip(0, 95)
    v = np.round(points[:, 1] / points[:, 2] * i.fy + i.cy).astype(int).clip(0, 71)
    inside = np.zeros_like(moving)
    inside[28:52, 28:68] = True  # a voxel's centre may be some pixels beside its samples
    assert not inside[v, u].any()


def test_a_map_is_the_same_to_the_bit_whatever_the_board_looks_like(mapped):
    first = mapped((0, 24), colour=RED, depth_mm=800).state()

    second = mapped((0, 24), colour=GREEN, depth_mm=0).state()

    assert first.values == second.values
    for name, tensor in first.tensors.items():
        assert torch.equal(tensor, second.tensors[name]), name


def rendered(seed: int) -> Rendered:
    generator = torch.Generator().manual_seed(seed)
    colour = torch.rand((72, 96, 3), generator=generator).requires_grad_()
    alpha = (0.6 + 0.4 * torch.rand((72, 96), generator=generator)).requires_grad_()
    depth = (1.0 + torch.rand((72, 96), generator=generator)).requires_grad_()
    screen = None
    return Rendered(colour, depth, alpha, screen)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("loss_of", [mapping_loss, mapping_loss_cpu], ids=["torch", "cpu"])
def test_moving_pixels_pull_at_nothing_and_the_others_do(
    loss_of, behind_board, calibration, moving
):
    image = rectify(behind_board(0), calibration).without(moving)
    exposure = torch.tensor([[1.0] * 3, [0.0] * 3], requires_grad=True)
    drawn = rendered(0)

    loss = loss_of(
        drawn,
        Target.of(image, torch.device("cpu")),
        Appearance(torch.zeros(3), exposure),
        LossConfig(),
    )
    loss.total.backward()

    for tensor in (drawn.colour, drawn.depth, drawn.alpha):
        assert tensor.grad is not None
        assert not tensor.grad[torch.from_numpy(moving)].any()
    assert drawn.colour.grad is not None
    assert (drawn.colour.grad[torch.from_numpy(~moving)] != 0).float().mean() > 0.9


def test_a_view_is_not_known_by_a_keyframe_that_a_board_hid_it_from(
    calibration, true_pose, frame, moving
):
    mappers = [Mapper(calibration, MappingConfig(), 0, torch.device("cpu")) for _ in range(2)]
    for mapper, cells in zip(mappers, (None, cells_of(moving)), strict=True):
        poses = KeyframePoses(1, np.array([0]), true_pose(0)[None])
        mapper.insert_keyframe(NewKeyframe(frame(0), poses, np.zeros((0, 3)), cells))
    points = rectify(frame(0), calibration)

    seen, hidden = (
        mapper.sightings.agreement(world_points(points, true_pose(0))[moving], mapper.views[0])
        for mapper in mappers
    )

    assert seen.mean() > 0.9
    assert hidden.max() < 1e-6


def test_nothing_is_looked_through_where_something_moves(calibration, true_pose, frame, moving):
    mapper = Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))
    poses = KeyframePoses(1, np.array([0]), true_pose(0)[None])
    mapper.insert_keyframe(NewKeyframe(frame(0), poses, np.zeros((0, 3)), cells_of(moving)))
    image = rectify(frame(0), calibration)
    before = world_points(replace(image, depth_m=0.5 * image.depth_m), true_pose(0))
    is_through = np.zeros(moving.size, bool)

    depths = mapper.sightings.coarse_depths(mapper.views.all())
    look_through(before.reshape(-1, 3).astype(np.float64), depths, (0.06, 0.03), is_through)

    is_through = is_through.reshape(moving.shape)
    assert not is_through[moving].any()
    assert is_through[60:68, 8:88].all()


def world_points(image: RgbdImage, T_world_camera: np.ndarray) -> np.ndarray:
    i = image.intrinsics
    v, u = np.mgrid[: i.height, : i.width]
    rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones_like(u)], -1)
    points = (rays * image.depth_m[..., None]).reshape(-1, 3)
    return se3.transform(T_world_camera, points).reshape(i.height, i.width, 3).astype(np.float32)


def test_cells_hold_every_pixel_of_a_mask_and_none_far_from_it():
    mask = np.zeros((50, 71), bool)
    mask[13, 40], mask[49, 70] = True, True

    pixels = pixels_of(cells_of(mask), 50, 71)

    assert pixels[mask].all()
    assert pixels.sum() == 64 + 2 * 7


def test_an_entry_carries_its_moving_cells_and_one_of_an_older_log_has_none(entry, moving):
    made = entry(0)
    masked = replace(made, keyframe=replace(made.keyframe, moving_cells=cells_of(moving)))
    older = codec.to_plain(made)
    del older["keyframe"]["moving_cells"]

    again = codec.unpack(Advance, codec.pack(masked))

    before = codec.from_plain(Advance, older)
    assert again.keyframe is not None and before.keyframe is not None
    assert again.keyframe.moving_cells is not None
    assert np.array_equal(again.keyframe.moving_cells, cells_of(moving))
    assert before.keyframe.moving_cells is None


def test_moving_cells_that_are_no_image_are_refused(entry):
    made = entry(0)
    keyframe = replace(made.keyframe, moving_cells=np.ones(3, bool))

    with pytest.raises(InputError, match="moving_cells"):
        check_entry(replace(made, keyframe=keyframe))

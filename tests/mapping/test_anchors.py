"""Anchors: rows that come and go together, voxels, seeding."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from services.mapping.anchors.anchor_map import AnchorMap, NewAnchors, trained_widths
from services.mapping.anchors.depth_fill import filled_depth
from services.mapping.anchors.rows import RowTable
from services.mapping.anchors.seeding import SeedRequest, seed_anchors
from services.mapping.anchors.voxels import centres, level_of, levels_at, sizes_m, voxel_keys
from services.mapping.config import AnchorConfig, MappingConfig
from services.mapping.decoding.decoders import NeuralDecoder, decoder_for
from services.mapping.rasterizer import Gaussians
from services.mapping.rasterizer.reference import rotations
from services.mapping.views.appearance import IDENTITY
from services.mapping.views.coverage import uncovered
from shared import se3
from shared.camera import Intrinsics
from shared.rectify import RgbdImage

CONFIG = AnchorConfig()
CAMERA = Intrinsics(fx=200.0, fy=200.0, cx=31.5, cy=23.5, width=64, height=48)


def new_anchors(count: int, is_primary: bool = False) -> NewAnchors:
    rng = np.random.default_rng(count)
    positions = rng.normal(0, 1, (count, 3)).astype(np.float32)
    return NewAnchors(
        positions=positions,
        features=rng.normal(0, 1, (count, 32)).astype(np.float32),
        offsets=rng.normal(0, 1, (count, 15)).astype(np.float32),
        scalings=np.full((count, 6), -3.0, np.float32),
        keys=voxel_keys(positions, np.zeros(count, np.int64), CONFIG),
        is_primary=np.full(count, is_primary),
    )


def wall(colour: tuple[int, int, int] = (200, 100, 50), depth_m: float = 2.0) -> RgbdImage:
    rgb = np.full((CAMERA.height, CAMERA.width, 3), colour, np.uint8)
    return RgbdImage(rgb, np.full(rgb.shape[:2], depth_m, np.float32), CAMERA)


def seeded(image: RgbdImage, landmarks: np.ndarray | None = None, taken=(), mask=True):
    is_uncovered = np.full(image.depth_m.shape, mask)
    points = np.zeros((0, 3)) if landmarks is None else landmarks
    request = SeedRequest(image, np.eye(4), is_uncovered, points, IDENTITY)
    keys = np.array(taken, np.int64)
    return seed_anchors(request, keys, CONFIG, np.random.default_rng(0))


def test_rows_that_are_removed_take_every_column_along():
    table = RowTable({"a": ((), torch.int64), "b": ((2,), torch.float32)}, torch.device("cpu"))
    table.append({"a": torch.arange(5), "b": torch.arange(10.0).view(5, 2)})

    table.keep(torch.tensor([True, False, True, False, True]))

    assert table["a"].tolist() == [0, 4, 2]
    assert table["b"][:, 0].tolist() == [0.0, 8.0, 4.0]


def test_columns_that_are_not_given_start_at_zero_even_where_rows_were_before():
    table = RowTable({"a": ((), torch.int64), "b": ((), torch.int64)}, torch.device("cpu"))
    table.append({"a": torch.arange(3), "b": torch.arange(3)})
    table.keep(torch.zeros(3, dtype=torch.bool))

    table.append({"a": torch.arange(3)})

    assert table["b"].tolist() == [0, 0, 0]


def test_voxels_double_with_the_depth():
    levels = levels_at(np.array([0.5, 1.0, 2.0, 4.0, 8.0]), CONFIG)

    np.testing.assert_allclose(sizes_m(levels, CONFIG), [0.005, 0.01, 0.02, 0.04, 0.08])


def test_points_of_one_voxel_share_a_key_that_names_its_level():
    points = np.array([[0.001, 0.001, 0.001], [0.019, 0.019, 0.019], [-0.001, 0.001, 0.001]])
    levels = np.zeros(3, np.int64)

    keys = voxel_keys(points, levels, CONFIG)

    assert keys[0] == keys[1] != keys[2]
    assert level_of(voxel_keys(points, levels + 3, CONFIG)).tolist() == [3, 3, 3]
    np.testing.assert_allclose(centres(points, levels, CONFIG)[0], [0.01, 0.01, 0.01])


def test_children_start_on_the_measured_surface_with_its_colour():
    new = seeded(wall())

    sides = np.exp(new.scalings[:, None, :3])
    children = new.positions[:, None] + new.offsets.reshape(len(new), -1, 3) * sides
    colours = 1 / (1 + np.exp(-new.features[:, :15]))
    assert len(new) > 50
    np.testing.assert_allclose(np.median(children[..., 2]), 2.0, atol=1e-3)
    np.testing.assert_allclose(colours[0].reshape(5, 3)[0], [200 / 255, 100 / 255, 50 / 255], 1e-5)


def test_voxels_that_are_taken_get_no_second_anchor():
    first = seeded(wall())

    assert len(seeded(wall(), taken=first.keys)) == 0


def test_what_the_map_explains_gets_no_anchor_but_for_orb_points():
    landmark = np.array([[0.0, 0.0, 2.0]])

    new = seeded(wall(), landmark, mask=False)

    assert len(new) == 1
    assert new.is_primary.all()


def test_orb_points_get_the_same_anchors_whatever_else_the_map_explains():
    rng = np.random.default_rng(1)
    image = wall()
    image.depth_m[:] = rng.uniform(0.3, 6.0, image.depth_m.shape)
    v, u = rng.integers(0, image.depth_m.shape, (40, 2)).T
    z = image.depth_m[v, u]
    slopes = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    landmarks = np.stack([slopes[0] * z, slopes[1] * z, z], 1).astype(np.float64)

    alone, among = seeded(image, landmarks, mask=False), seeded(image, landmarks, mask=True)

    np.testing.assert_array_equal(alone.keys, among.keys[among.is_primary])
    np.testing.assert_array_equal(alone.scalings, among.scalings[among.is_primary])


def test_depth_of_nothing_seeds_nothing():
    assert len(seeded(wall(depth_m=0.0))) == 0


@pytest.mark.parametrize(
    ("alpha", "depth_m", "expected"), [(0.2, 0.4, True), (1.0, 2.0, False), (1.0, 2.5, True)]
)
def test_a_pixel_is_uncovered_when_open_or_drawn_behind_the_measurement(alpha, depth_m, expected):
    a, b, c = (np.full((1, 1), value, np.float32) for value in (alpha, depth_m, 2.0))

    assert uncovered(a, b, c, CONFIG).item() is expected


def test_the_cap_keeps_primary_anchors_first():
    anchors = AnchorMap(AnchorConfig(max_anchors=10), torch.device("cpu"))
    mixed = new_anchors(20)
    mixed.is_primary[15:] = True

    added = anchors.append(mixed, creator_seq=0)

    assert (added, anchors.num_primary) == (10, 5)


def test_a_map_above_its_cap_takes_no_more():
    anchors = AnchorMap(CONFIG, torch.device("cpu"))
    anchors.append(new_anchors(20), creator_seq=0)
    resumed = AnchorMap(AnchorConfig(max_anchors=10), torch.device("cpu"))
    resumed.restore(anchors.state())

    added = resumed.append(new_anchors(5), creator_seq=8)

    assert (added, len(resumed)) == (0, 20)


def test_a_corrected_keyframe_takes_only_its_own_anchors_along():
    anchors = AnchorMap(CONFIG, torch.device("cpu"))
    anchors.append(new_anchors(4), creator_seq=0)
    anchors.append(new_anchors(3), creator_seq=8)
    before = anchors.rows["position"].clone()
    T_new_old = se3.exp([0.5, 0.0, 0.0, 0.0, 0.0, 0.3])

    anchors.move(8, T_new_old)

    expected = se3.transform(T_new_old, before[4:].numpy())
    assert torch.equal(anchors.rows["position"][:4], before[:4])
    np.testing.assert_allclose(anchors.rows["position"][4:], expected, atol=1e-6)


@pytest.mark.parametrize("gaussians", ["neural", "plain"])
def test_a_keyframe_without_anchors_can_be_corrected(gaussians):
    anchors = AnchorMap(AnchorConfig(gaussians=gaussians), torch.device("cpu"))
    anchors.append(new_anchors(4), creator_seq=0)
    before = anchors.rows["position"].clone()

    anchors.move(8, se3.exp([0.5, 0.0, 0.0, 0.0, 0.0, 0.3]))

    assert torch.equal(anchors.rows["position"], before)


def test_children_turn_with_their_anchor():
    anchors = AnchorMap(CONFIG, torch.device("cpu"))
    anchors.append(new_anchors(3), creator_seq=0)
    T_new_old = se3.exp([0.1, 0.2, 0.0, 0.2, 0.0, 0.3])

    def children() -> np.ndarray:
        offsets = (
            anchors.rows["offsets"].view(3, 5, 3) * anchors.rows["scalings"][:, None, :3].exp()
        )
        return (anchors.rows["position"][:, None] + offsets).view(-1, 3).numpy()

    before = children()
    anchors.move(0, T_new_old)

    np.testing.assert_allclose(children(), se3.transform(T_new_old, before), atol=1e-5)


@pytest.mark.parametrize("gaussians", ["neural", "plain"])
def test_a_corrected_keyframe_sees_its_gaussians_as_before(gaussians):
    config = MappingConfig(anchors=AnchorConfig(gaussians=gaussians))
    anchors = AnchorMap(config.anchors, torch.device("cpu"))
    anchors.append(new_anchors(30), creator_seq=0)
    generator = torch.Generator().manual_seed(0)
    for name in trained_widths(config.anchors):
        anchors.rows[name].add_(0.5 * torch.randn(anchors.rows[name].shape, generator=generator))
    decoder = decoder_for(config, 0, torch.device("cpu"))
    if isinstance(decoder, NeuralDecoder):
        for weight in decoder.weights.values():
            weight.data.add_(0.3 * torch.randn(weight.shape, generator=generator))
    T_new_old, camera = se3.exp([0.5, 0.1, 0.0, 0.3, 0.0, -0.8]), np.array([[0.2, -0.1, -1.0]])

    def seen_from(centre: np.ndarray) -> Gaussians:
        at = torch.from_numpy(centre[0].astype(np.float32))
        return decoder.decode(anchors, torch.arange(30), at)[1]

    before = seen_from(camera)
    anchors.move(0, T_new_old)
    after = seen_from(se3.transform(T_new_old, camera))

    R = torch.from_numpy(T_new_old[:3, :3]).float()
    expected = se3.transform(T_new_old, before.means.detach().numpy())
    np.testing.assert_allclose(after.means.detach(), expected, atol=1e-5)
    turned = R @ rotations(before.quats_wxyz)
    torch.testing.assert_close(rotations(after.quats_wxyz), turned, atol=1e-5, rtol=0)
    for name in ("scales", "opacities", "colours"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))


def test_holes_are_filled_from_around_and_measurements_stay():
    depth = np.full((9, 7), 2.0, np.float32)
    depth[:, 4:] = 3.0
    depth[2:6, 1:3] = 0.0

    filled = filled_depth(depth)

    assert (filled[2:6, 1:3] > 1.9).all()
    assert (filled[2:6, 1:3] < 3.1).all()
    np.testing.assert_array_equal(filled[depth > 0], depth[depth > 0])


def test_a_hole_in_a_slanted_wall_continues_the_wall():
    v, u = np.mgrid[:120, :160]
    wall = (1.0 / (0.3 + 0.001 * u + 0.0007 * v)).astype(np.float32)
    depth = wall.copy()
    depth[30:80, 40:100] = 0.0

    np.testing.assert_allclose(filled_depth(depth), wall, rtol=0.005)


def test_an_image_without_depth_stays_empty():
    assert filled_depth(np.zeros((5, 4), np.float32)).max() == 0.0

"""The mapper as a whole: a few frames of a known room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from services.mapping.anchors import densification
from services.mapping.config import (
    AnchorConfig,
    DensificationConfig,
    LearningRates,
    MappingConfig,
    RefinementConfig,
    ScheduleConfig,
)
from services.mapping.export.baking import BakedGaussians, MapCopy, bake
from services.mapping.pipeline import Mapper, NewKeyframe
from services.mapping.rasterizer import Gaussians, View
from shared import se3
from shared.errors import InputError
from shared.maps import RenderRequest
from shared.tracks import KeyframePoses


@pytest.fixture
def mapper(calibration) -> Mapper:
    return Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))


@pytest.fixture
def insert(frame, true_pose):
    """Inserts a keyframe at its true pose; others may be given new poses."""

    def run(mapper: Mapper, seq: int, **moved: np.ndarray) -> int:
        seqs = [*mapper.views.seqs(), seq]
        poses = np.stack([moved[f"at_{s}"] if f"at_{s}" in moved else true_pose(s) for s in seqs])
        keyframe_poses = KeyframePoses(len(seqs), np.array(seqs), poses)
        return mapper.insert_keyframe(NewKeyframe(frame(seq), keyframe_poses, np.zeros((0, 3))))

    return run


@pytest.fixture
def psnr_db(calibration, true_pose, true_colour):
    """PSNR of a rendered frame against its exact colours."""

    def score(mapper: Mapper, seq: int) -> float:
        request = RenderRequest(true_pose(seq), calibration.colour.intrinsics)
        error = mapper.render(request).rgb / 255.0 - true_colour(seq) / 255.0
        return float(-10 * np.log10(np.mean(error**2)))

    return score


def test_a_view_between_keyframes_is_rendered_well_after_a_few_iterations(mapper, insert, psnr_db):
    for seq in (0, 4, 8):
        insert(mapper, seq)
        mapper.iterate(30)

    assert psnr_db(mapper, 6) > 30.0


def test_a_plain_map_renders_a_view_between_keyframes_well_too(calibration, insert, psnr_db):
    config = MappingConfig(anchors=AnchorConfig(gaussians="plain"))
    mapper = Mapper(calibration, config, 0, torch.device("cpu"))

    for seq in (0, 4, 8):
        insert(mapper, seq)
        mapper.iterate(20)

    assert psnr_db(mapper, 6) > 30.0


def test_an_empty_plain_map_is_rendered_as_nothing(calibration, true_pose):
    config = MappingConfig(anchors=AnchorConfig(gaussians="plain"))
    mapper = Mapper(calibration, config, 0, torch.device("cpu"))

    view = mapper.render(RenderRequest(true_pose(0), calibration.colour.intrinsics))

    assert not view.alpha.any()
    assert not view.confidence.any()


def test_rendered_depth_is_the_measured_depth(mapper, insert, calibration, true_pose):
    insert(mapper, 0)
    mapper.iterate(60)

    reply = mapper.render(RenderRequest(true_pose(0), calibration.colour.intrinsics))

    image = mapper.views.image(0)
    solid = reply.alpha > 200
    assert solid.mean() > 0.9
    assert np.abs(reply.depth_m - image.depth_m)[solid].mean() < 0.02


def test_a_second_look_at_the_same_place_adds_hardly_any_anchor(mapper, insert):
    first = insert(mapper, 0)
    mapper.iterate(30)

    second = insert(mapper, 1)

    assert second < 0.15 * first


def test_a_correction_moves_the_keyframes_anchors(mapper, insert, true_pose):
    insert(mapper, 0)
    before = mapper.anchors.rows["position"].clone()
    moved = se3.exp([0.05, 0, 0, 0, 0, 0]) @ true_pose(0)

    insert(mapper, 4, at_0=moved)

    shift = mapper.anchors.rows["position"][: len(before)] - before
    torch.testing.assert_close(shift, torch.tensor([[0.05, 0.0, 0.0]]).expand_as(shift))


def test_a_correction_of_a_millimetre_moves_no_anchor(mapper, insert, true_pose):
    insert(mapper, 0)
    before = mapper.anchors.rows["position"].clone()

    insert(mapper, 4, at_0=se3.exp([0.001, 0, 0, 0, 0, 0]) @ true_pose(0))

    assert torch.equal(mapper.anchors.rows["position"][: len(before)], before)


def test_the_newest_keyframe_gets_its_share_of_draws(mapper, insert):
    for seq in (0, 4, 8, 12):
        insert(mapper, seq)

    draws = [mapper.views.draw().seq for _ in range(2000)]

    expected = ScheduleConfig().newest_share + (1 - ScheduleConfig().newest_share) / 4
    assert np.mean(np.array(draws) == 12) == pytest.approx(expected, abs=0.04)


def test_a_new_keyframe_is_drawn_before_any_other(mapper, insert):
    for seq in (0, 4, 8, 12):
        insert(mapper, seq)

        assert mapper.views.draw().seq == seq


def test_with_overlapping_draws_only_keyframes_of_the_same_place_are_drawn(
    calibration, insert, true_pose
):
    config = MappingConfig(schedule=ScheduleConfig(draws="overlapping"))
    mapper = Mapper(calibration, config, 0, torch.device("cpu"))
    turned = true_pose(0) @ se3.exp([0, 0, 0, 0, np.pi, 0])
    insert(mapper, 0)
    insert(mapper, 4, at_0=turned, at_4=true_pose(4))

    insert(mapper, 8, at_0=turned)

    assert {mapper.views.draw().seq for _ in range(100)} == {4, 8}


def test_a_refinement_sees_every_keyframe_once_a_round(mapper, insert):
    for seq in (0, 4, 8, 12):
        insert(mapper, seq)

    assert sorted(mapper.views.draw_in_rounds().seq for _ in range(4)) == [0, 4, 8, 12]


def test_faint_anchors_are_culled_but_primary_ones_stay(mapper, insert):
    insert(mapper, 0)
    rows = mapper.anchors.rows
    rows["visits"][:10] = 100.0
    rows["is_primary"][:4] = True
    before = len(rows)

    culled = densification.cull(mapper.anchors, DensificationConfig())

    assert (culled, len(rows)) == (6, before - 6)


def test_anchors_grow_where_the_screen_gradient_is_large(mapper, insert):
    insert(mapper, 0)
    rows = mapper.anchors.rows
    rows["gradient_visits"][:] = 20.0
    rows["gradient_sum"][3, 1] = 1.0
    config = DensificationConfig(grow_share=1.0)
    child = rows["offsets"][3].view(5, 3)[1] * rows["scalings"][3, :3].exp()
    place = rows["position"][3] + child
    side = rows["scalings"][3, 0].exp() / 2

    added = densification.grow(
        mapper.anchors, config, mapper.config.anchors, np.random.default_rng(0)
    )

    assert added == 1
    assert (mapper.anchors.rows["position"][-1] - place).abs().max() <= side / 2 + 1e-6


@pytest.fixture
def halving(calibration, insert) -> Mapper:
    """A map by the paper's rule, where child 1 of anchor 3 sits on anchor 7 and has a gradient."""
    config = MappingConfig(densification=DensificationConfig(rule="halving", grow_share=1.0))
    mapper = Mapper(calibration, config, 0, torch.device("cpu"))
    insert(mapper, 0)
    rows = mapper.anchors.rows
    unit = rows["scalings"][3, :3].exp()
    rows["offsets"][3, 3:6] = (rows["position"][7] - rows["position"][3]) / unit
    rows["gradient_visits"][:] = 20.0
    rows["gradient_sum"][3, 1] = 1.0
    return mapper


def grow(mapper: Mapper) -> int:
    config = mapper.config
    rng = np.random.default_rng(0)
    return densification.grow(mapper.anchors, config.densification, config.anchors, rng)


def test_by_the_papers_rule_the_anchor_in_a_voxel_with_a_large_gradient_is_halved(halving):
    added = grow(halving)

    gates = halving.anchors.rows["gate"]
    assert (added, float(gates[7])) == (0, 0.5)
    assert float(gates.sum()) == len(gates) - 0.5


def test_by_the_papers_rule_primary_anchors_are_never_halved(halving):
    halving.anchors.rows["is_primary"][7] = True

    grow(halving)

    assert (halving.anchors.rows["gate"] == 1.0).all()


def test_a_halved_anchor_opens_again_when_its_voxel_asks_no_more(halving):
    grow(halving)

    grow(halving)

    assert (halving.anchors.rows["gate"] == 1.0).all()


def test_a_halved_anchor_is_drawn_with_half_its_opacity(halving):
    index, camera = torch.arange(9), torch.zeros(3)
    before = halving.painter.gaussians(index, camera)[1].opacities.view(9, 5)
    halving.anchors.rows["gate"][7] = 0.5

    after = halving.painter.gaussians(index, camera)[1].opacities.view(9, 5)

    torch.testing.assert_close(after[7], 0.5 * before[7])
    assert torch.equal(after[:7], before[:7])


def test_adams_moments_follow_anchors_when_others_go_and_come(mapper, insert):
    insert(mapper, 0)
    mapper.iterate(5)
    rows = mapper.anchors.rows
    is_kept = torch.arange(len(rows)) % 3 != 0
    names = [n for n in rows.state() if n.endswith(("_mean", "_square")) or n == "steps"]
    by_voxel = rows["key"][is_kept].argsort()
    expected = {name: rows[name][is_kept][by_voxel] for name in names}

    rows.keep(is_kept)
    insert(mapper, 40)

    kept = int(is_kept.sum())
    by_voxel = rows["key"][:kept].argsort()
    assert len(rows) > kept
    for name in names:
        assert torch.equal(rows[name][:kept][by_voxel], expected[name])
        assert not rows[name][kept:].any()


def test_anchors_grow_in_the_first_part_of_a_refinement_only(calibration, insert):
    densification = DensificationConfig(first_iteration=0, grow_interval=1, min_visits=1)
    mapper = Mapper(calibration, MappingConfig(densification=densification), 0, torch.device("cpu"))
    insert(mapper, 0)
    sizes = [len(mapper.anchors)]

    for progress in (0.1, 0.6, 0.9):
        mapper.refine(progress)
        sizes.append(len(mapper.anchors))

    assert sizes[0] < sizes[1] == sizes[2] == sizes[3]


@pytest.mark.parametrize(("progress", "step"), [(0.0, 0.03), (0.5, 0.015)])
def test_a_refinement_steps_at_rates_of_its_own_that_decay(calibration, insert, progress, step):
    refinement = RefinementConfig(LearningRates(features=0.03), decay=0.25)
    config = MappingConfig(anchors=AnchorConfig(young_boost=0.0), refinement=refinement)
    mapper = Mapper(calibration, config, 0, torch.device("cpu"))
    insert(mapper, 0)
    before = mapper.anchors.rows["features"].clone()

    mapper.refine(progress)

    moved = (mapper.anchors.rows["features"] - before).abs().max()
    assert float(moved) == pytest.approx(step, rel=1e-3)  # Adam's first step is its rate


def test_a_keyframe_whose_image_is_damaged_is_refused_and_not_trained_on(
    mapper, insert, frame, true_pose
):
    insert(mapper, 0)
    damaged = replace(frame(4), rgb=replace(frame(4).rgb, bytes=b"\xff\xd8 no image"))
    poses = KeyframePoses(2, np.array([0, 4]), np.stack([true_pose(0), true_pose(4)]))

    with pytest.raises(InputError, match="rgb"):
        mapper.insert_keyframe(NewKeyframe(damaged, poses, np.zeros((0, 3))))

    assert mapper.views.seqs() == [0]


def baked_whole(copy: MapCopy, degree: int = 3) -> BakedGaussians:
    blocks = list(bake(copy, degree))
    columns = (torch.cat(c) for c in zip(*(b.gaussians.tensors() for b in blocks), strict=True))
    return BakedGaussians(Gaussians(*columns), torch.cat([b.harmonics for b in blocks]))


def test_a_baked_map_holds_only_gaussians_that_show(mapper, insert):
    insert(mapper, 0)
    mapper.iterate(10)

    found = baked_whole(MapCopy.of(mapper))

    assert 0 < len(found.gaussians.means) <= 5 * len(mapper.anchors)
    assert found.gaussians.opacities.min() > 1 / 255
    assert found.harmonics.shape[1:] == (16, 3)


def test_a_map_without_keyframes_bakes_to_nothing(mapper):
    assert list(bake(MapCopy.of(mapper), degree=3)) == []


def test_a_copy_for_baking_is_not_touched_by_the_optimisation(mapper, insert):
    insert(mapper, 0)
    mapper.iterate(5)
    before = baked_whole(copy := MapCopy.of(mapper))

    mapper.iterate(5)

    assert torch.equal(before.harmonics, baked_whole(copy).harmonics)


def test_baked_harmonics_come_nearer_to_the_map_than_a_single_colour(
    mapper, insert, calibration, true_pose
):
    for seq in (0, 4, 8, 12, 16):
        insert(mapper, seq)
        mapper.iterate(30)
    with torch.no_grad():  # this room is dull: let colours depend on the direction
        weights, generator = mapper.painter.decoder.weights, torch.Generator().manual_seed(0)
        weights["hidden_weight"][32:35, 32:64].normal_(generator=generator)
        weights["colour_weight"].normal_(std=0.1, generator=generator)
    view = View(se3.inverse(true_pose(6)), calibration.colour.intrinsics)
    expected = mapper.painter.draw(view).rendered.colour
    copy, camera = MapCopy.of(mapper), torch.from_numpy(true_pose(6)[:3, 3]).float()

    def error(degree: int) -> float:
        seen = baked_whole(copy, degree).seen_from(camera)
        return float((mapper.painter.rasterizer(seen, view).colour - expected).square().mean())

    assert error(3) < 0.8 * error(0)


def test_a_keyframe_that_sees_none_of_the_map_does_not_hinder_baking(mapper, insert):
    insert(mapper, 0)
    copy = MapCopy.of(mapper)
    (view,) = copy.views
    away = replace(view, T_world_camera=se3.exp([0, 0, 0, 0, np.pi, 0]))

    baked = baked_whole(replace(copy, views=[view, away]))

    assert torch.equal(baked.harmonics, baked_whole(copy).harmonics)


def test_a_keyframe_without_depth_does_no_harm(mapper, insert, frame, true_pose):
    blind = frame(0).depth
    keyframe = replace(frame(0), depth=replace(blind, bytes=bytes(len(blind.bytes))))
    poses = KeyframePoses(1, np.array([0]), true_pose(0)[None])

    added = mapper.insert_keyframe(NewKeyframe(keyframe, poses, np.zeros((0, 3))))
    mapper.iterate(2)

    assert added == 0

"""`pointslam bench mapping`: one tiny run from feeding to the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import mapping
from benchmarks.mapping_run import MappingRun, RunPlan
from pointslam.synth import Noise, SynthOptions, write_sequence
from services.mapping.config import MappingConfig
from shared.camera import Intrinsics
from shared.config import override, read_overrides

SMALL = Intrinsics(80.0, 80.0, 47.5, 35.5, 96, 72)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sequence") / "room"
    options = SynthOptions(num_frames=12, noise=Noise.NONE, num_views=2, camera=SMALL)
    write_sequence(folder, options)
    return folder


def plan(room: Path, *words: str) -> RunPlan:
    return mapping.plan_of(mapping.arguments([str(room), "--refine", "8", "--scores", "2", *words]))


def test_a_run_scores_after_the_online_phase_and_each_part_of_the_refinement(room):
    result = MappingRun(plan(room, "--iterations", "1")).measure()

    phases = [(point["phase"], point["iterations"]) for point in result["curve"]]
    assert phases == [("online", 12), ("refined", 16), ("refined", 20)]
    assert result["curve"][-1]["seconds"] > result["curve"][0]["seconds"]
    assert all(result["curve"][0][block]["psnr_db"] > 10 for block in ("all", "heldout", "novel"))


def test_a_result_becomes_a_line_for_its_costs_and_one_for_each_score(room):
    result = MappingRun(plan(room, "--iterations", "1")).measure()

    text = list(mapping.lines("full", result))

    assert text[0].startswith("full: 3 keyframes")
    assert len(text) == 4


@pytest.mark.parametrize("name", mapping.VARIANTS)
def test_every_variant_but_the_full_one_changes_the_settings(name):
    changed = override(MappingConfig(), read_overrides(None, mapping.VARIANTS[name]))

    assert (changed == MappingConfig()) == (name == "full")


def test_the_ablation_table_is_relative_to_the_full_map():
    def ending_at(psnr_db: float) -> dict:
        return {"curve": [{"heldout": {"psnr_db": psnr_db, "ssim": 0.9}}]}

    text = list(mapping.ablation({"full": ending_at(30.0), "plain": ending_at(29.0)}))

    assert text[1].split()[:2] == ["full", "+0.00"]
    assert text[2].split()[:2] == ["plain", "-1.00"]

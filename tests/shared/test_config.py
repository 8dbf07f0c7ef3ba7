from dataclasses import dataclass, field

import pytest

from shared.config import override, read_overrides
from shared.errors import ConfigError


@dataclass(frozen=True)
class Step:
    voxel_size_m: float = 0.05
    iterations: int = 20
    is_on: bool = True

    def __post_init__(self) -> None:
        if self.voxel_size_m <= 0:
            raise ConfigError(f"voxel_size_m must be positive, got {self.voxel_size_m}")


@dataclass(frozen=True)
class Config:
    step: Step = field(default_factory=Step)
    name: str = "a"


def test_a_nested_setting_changes_and_the_rest_stays():
    changed = override(Config(), {"step": {"voxel_size_m": 0.1}})

    assert changed == Config(step=Step(voxel_size_m=0.1))


def test_words_win_over_the_file(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("step: {iterations: 5, voxel_size_m: 0.2}\n")

    changes = read_overrides(file, ["step.iterations=7"])

    assert changes == {"step": {"iterations": 7, "voxel_size_m": 0.2}}


def test_a_number_in_scientific_notation_is_a_number():
    assert (
        override(Config(), read_overrides(None, ["step.voxel_size_m=1e-2"])).step.voxel_size_m
        == 0.01
    )


def test_a_misspelt_key_lists_the_right_ones():
    with pytest.raises(ConfigError, match=r"step\.voxel_size.*voxel_size_m, iterations, is_on"):
        override(Config(), {"step": {"voxel_size": 1.0}})


def test_a_value_out_of_range_is_refused():
    with pytest.raises(ConfigError, match="must be positive, got -1"):
        override(Config(), {"step": {"voxel_size_m": -1.0}})


@pytest.mark.parametrize("value", [1, "yes", None])
def test_a_switch_takes_only_true_and_false(value):
    with pytest.raises(ConfigError, match="is_on must be bool"):
        override(Config(), {"step": {"is_on": value}})


@pytest.mark.parametrize("word", ["voxel_size_m=.nan", "voxel_size_m=.inf", "voxel_size_m=1e999"])
def test_a_number_that_is_none_is_refused(word):
    with pytest.raises(ConfigError, match=r"step\.voxel_size_m must be float"):
        override(Config(), read_overrides(None, [f"step.{word}"]))


def test_a_group_is_not_a_value():
    with pytest.raises(ConfigError, match="step is a group"):
        override(Config(), {"step": 3})


def test_a_word_without_equals_is_refused():
    with pytest.raises(ConfigError, match="key=value"):
        read_overrides(None, ["step.iterations"])


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.yaml"):
        read_overrides(tmp_path / "absent.yaml", [])

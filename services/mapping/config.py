"""Settings of the mapping service; one group a step, units in the names."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from services.mapping.keyframes.store import KeyframeConfig
from shared.errors import ConfigError
from shared.fabric import BusConfig


def _check(is_fine: bool, text: str) -> None:
    if not is_fine:
        raise ConfigError(text)


def _check_choice(value: str, choices: tuple[str, ...], name: str) -> None:
    _check(value in choices, f"{name} must be {' or '.join(choices)}, got {value}")


@dataclass(frozen=True)
class AnchorConfig:
    """Where anchors go and how they start (paper, "Neural-Gaussian Representation")."""

    gaussians: str = "neural"  # or "plain": parameters of their own, no networks (an ablation)
    features: str = "colours"  # what they start with; or "environment" (Eq. 7), "both", "random"
    children: int = 5  # k, Gaussians per anchor
    voxel_size_m: float = 0.02  # at the reference depth; doubles and halves with the depth
    reference_depth_m: float = 2.0
    max_anchors: int = 400_000
    initial_opacity: float = 0.6
    initial_sigma: float = 0.6  # of the spacing of the depth samples
    primary_rate: float = 0.5  # of the secondary anchors' learning rate; 0.1 costs 0.2 to 0.3 dB
    young_boost: float = 4.0  # a new anchor learns (1 + young_boost exp(-t / young_steps)) times
    young_steps: float = 10.0  # as fast at its step t: it may have few, or many to settle in
    fusion_steps: float = 5.0  # an anchor that has learned for so many steps takes over half of
    # what a new keyframe sees differently, a younger one more; 0: none does
    min_alpha: float = 0.5  # a pixel below this is not covered by the map
    min_depth_gap_m: float = 0.03  # measured depth this much in front, and by this share,
    min_depth_gap: float = 0.06  # is not covered
    carve_window_px: int = 5  # odd; all readings in it must be behind an anchor to carve it
    min_samples: int = 2  # depth samples in a voxel that make an anchor
    fill_holes: bool = True  # seed pixels without depth too, at the depth around them or behind it

    def __post_init__(self) -> None:
        _check_choice(self.gaussians, ("neural", "plain"), "anchors.gaussians")
        starts = ("colours", "environment", "both", "random")
        _check_choice(self.features, starts, "anchors.features")
        is_neural = self.gaussians == "neural"
        _check(is_neural or self.features == "colours", "plain Gaussians start with colours")
        _check(1 <= self.children <= 10, f"anchors.children must be 1 to 10, got {self.children}")
        _check(self.voxel_size_m > 0, "anchors.voxel_size_m must be positive")
        _check(self.reference_depth_m > 0, "anchors.reference_depth_m must be positive")
        _check(self.max_anchors > 0, "anchors.max_anchors must be positive")
        _check(self.young_boost >= 0, "anchors.young_boost must not be negative")
        _check(self.young_steps > 0, "anchors.young_steps must be positive")
        _check(self.fusion_steps >= 0, "anchors.fusion_steps must not be negative")
        _check(self.carve_window_px % 2 == 1, "anchors.carve_window_px must be odd")
        _check(0 < self.initial_opacity < 1, "anchors.initial_opacity must be between 0 and 1")


@dataclass(frozen=True)
class DecoderConfig:
    """The networks F_a of Eq. 6."""

    hidden: int = 32
    max_visible_anchors: int = 250_000  # the nearest ones are drawn

    def __post_init__(self) -> None:
        _check(self.hidden > 0, "decoder.hidden must be positive")
        _check(self.max_visible_anchors > 0, "decoder.max_visible_anchors must be positive")


@dataclass(frozen=True)
class LearningRates:
    """Steps of Adam, per parameter."""

    features: float = 1e-2
    offsets: float = 0.02
    scalings: float = 0.025
    colours: float = 0.05  # of plain Gaussians, as the next three
    opacities: float = 0.05
    sizes: float = 0.02
    turns: float = 0.01
    opacity_network: float = 2e-3
    colour_network: float = 8e-3
    covariance_network: float = 4e-3
    exposure_gain: float = 5e-3
    exposure_bias: float = 2e-3
    poses: float = 0.0  # share of the Gauss-Newton step that aligns a keyframe with the map

    def scaled(self, factor: float) -> LearningRates:
        """All rates times a factor."""
        return LearningRates(**{f.name: factor * getattr(self, f.name) for f in fields(self)})


@dataclass(frozen=True)
class RefinementConfig:
    """Steps of Adam in a refinement: wide at first, as there is time to settle."""

    rates: LearningRates = LearningRates(
        features=0.04, offsets=0.05, scalings=0.05, opacity_network=8e-3, poses=0.3
    )
    decay: float = 0.2  # of all rates, at the end

    def __post_init__(self) -> None:
        _check(0 < self.decay <= 1, f"refinement.decay must be 0 to 1, got {self.decay}")

    def at(self, progress: float) -> LearningRates:
        """The rates at 0 <= `progress` < 1 of a refinement."""
        return self.rates.scaled(self.decay**progress)


@dataclass(frozen=True)
class ExposureConfig:
    """The exposure that a new keyframe starts with: the one before it, or fitted to the map."""

    min_overlap: float = 0.1  # of the pixels; with less, the one before it
    min_alpha: float = 0.9
    pixel_step: int = 6  # every so many pixels of a row and column, at half the size
    gain_inertia: float = 0.01  # weight of the gain before it, in all the pixels' weight
    bias_inertia: float = 0.5
    min_improvement: float = 0.05  # of the residuals' cost, for another exposure to be taken

    def __post_init__(self) -> None:
        _check(0 <= self.min_overlap <= 1, "exposure.min_overlap must be 0 to 1")
        _check(self.pixel_step > 0, "exposure.pixel_step must be positive")
        is_fine = self.gain_inertia > 0 and self.bias_inertia > 0
        _check(is_fine, "exposure.gain_inertia and bias_inertia must be positive")


@dataclass(frozen=True)
class LossConfig:
    """Weights of Eq. 8; the colour terms share one: (1 - ssim) (L1 + square L2) + ssim (1 - SSIM).

    L1 alone settles on the median of what views of a surface show; where highlights and exposure
    make them disagree, the squared error draws large residuals in within fewer steps (+0.2 dB on
    a real office, equal where views agree).
    """

    ssim: float = 0.2
    square: float = 4.0  # of the squared colour error: equal to L1 at an error of 1 / square
    depth: float = 0.1
    max_depth_error_m: float = 0.3  # a larger error is an outlier of the sensor

    def __post_init__(self) -> None:
        _check(0 <= self.ssim <= 1, f"loss.ssim must be 0 to 1, got {self.ssim}")
        _check(self.square >= 0, f"loss.square must not be negative, got {self.square}")
        _check(self.depth >= 0, f"loss.depth must not be negative, got {self.depth}")


@dataclass(frozen=True)
class DensificationConfig:
    """Growing and culling of secondary anchors, counted in iterations."""

    first_iteration: int = 1500
    grow_interval: int = 200
    grow_share: float = 0.01  # of the anchors, each time
    grow_until: float = 0.5  # of a refinement: what grows at its end stays untrained
    min_visits: int = 8  # a child is judged after so many iterations that saw it
    cull_interval: int = 200
    rule: str = "scaffold"  # or "halving": the paper's, where a voxel with too large a gradient
    # has an anchor already, that one fades
    cull_opacity: float = 0.005  # mean of an anchor's children
    cull_visits: int = 20

    def __post_init__(self) -> None:
        _check_choice(self.rule, ("scaffold", "halving"), "densification.rule")
        _check(self.grow_interval > 0, "densification.grow_interval must be positive")
        _check(self.cull_interval > 0, "densification.cull_interval must be positive")
        _check(0 <= self.grow_share <= 1, "densification.grow_share must be 0 to 1")


@dataclass(frozen=True)
class ScheduleConfig:
    """Which keyframe each iteration draws, and how many iterations a frame gives."""

    iterations_per_frame: int = 2
    newest_share: float = 0.1  # of draws after its first; 0.3 costs up to 0.8 dB
    draws: str = "all"  # of the others: uniform over all, or the "overlapping" ones,
    min_overlap: float = 0.3  # that see this share of the newest keyframe's points
    cached_views: int = 2  # with their statistics for SSIM: 19 MB each at 640x480, 3 ms to remake
    cached_images_mb: int = 48  # decoded images: 2 MB each at 640x480, 5 ms to decode anew
    min_shift_m: float = 0.002  # a keyframe corrected by more takes its anchors along
    min_turn_deg: float = 0.05

    def __post_init__(self) -> None:
        _check(self.iterations_per_frame >= 0, "schedule.iterations_per_frame is negative")
        _check(0 <= self.newest_share <= 1, "schedule.newest_share must be 0 to 1")
        _check_choice(self.draws, ("all", "overlapping"), "schedule.draws")
        _check(0 <= self.min_overlap <= 1, "schedule.min_overlap must be 0 to 1")
        _check(self.cached_views > 0, "schedule.cached_views must be positive")


@dataclass(frozen=True)
class RenderConfig:
    """Drawn views that are kept (see `render_cache`)."""

    cache_mb: int = 48
    max_iterations: int = 10  # a kept view may be so many steps of optimisation behind the map
    max_age_s: float = 0.5  # and so old, while the map is optimised

    def __post_init__(self) -> None:
        _check(self.cache_mb >= 0, "render.cache_mb must not be negative")
        _check(self.max_iterations >= 0, "render.max_iterations must not be negative")


@dataclass(frozen=True)
class ExportConfig:
    """The map as a file."""

    harmonics_degree: int = (
        3  # of the colours in a PLY of splats; 0 makes the file 3.6 times smaller
    )
    preview_splats: int = 60_000  # at most, in a preview: 68 bytes each

    def __post_init__(self) -> None:
        fine = 0 <= self.harmonics_degree <= 3
        _check(fine, f"export.harmonics_degree must be 0 to 3, got {self.harmonics_degree}")
        _check(self.preview_splats > 0, "export.preview_splats must be positive")


@dataclass(frozen=True)
class OwnerConfig:
    """The session around the map."""

    max_pending: int = 8  # offline: entries not yet worked through, before replies wait
    max_pending_live: int = 100
    snapshot_interval_s: float = 180.0
    live_idle_s: float = 60.0  # live: optimise for so long after the last entry
    session_idle_s: float = 600.0  # a session that nobody asks for so long goes to disk,
    yield_idle_s: float = 15.0  # and after so long already where another one needs its place
    chunk_bytes: int = 4 << 20
    lease_s: float = 5.0  # a frozen owner's sessions are free to others after so long
    lease_store: str = ""  # SQLite beside the sessions, or postgresql://user@host/name
    max_sessions: int = 16  # open at a time; others go to another mapper
    niceness: int = 5  # steps that the threads that optimise stay below those that answer

    def __post_init__(self) -> None:
        _check(0 <= self.niceness <= 19, "owner.niceness must be 0 to 19")
        _check(self.max_pending > 0, "owner.max_pending must be positive")
        _check(self.max_pending_live > 0, "owner.max_pending_live must be positive")
        _check(self.session_idle_s > 0, "owner.session_idle_s must be positive")
        _check(self.yield_idle_s >= 0, "owner.yield_idle_s must not be negative")
        _check(self.lease_s >= 0.5, f"owner.lease_s must be at least 0.5, got {self.lease_s}")
        _check(self.max_sessions > 0, "owner.max_sessions must be positive")
        _check(self.chunk_bytes > 0, "owner.chunk_bytes must be positive")


@dataclass(frozen=True)
class RetentionConfig:
    """When sessions that are neither open nor pinned are deleted, oldest first; 0: never."""

    max_days: float = 0.0  # since they were written to last
    max_gb: float = 0.0  # of all sessions together, 1e9 bytes

    def __post_init__(self) -> None:
        _check(self.max_days >= 0, "retention.max_days must not be negative")
        _check(self.max_gb >= 0, "retention.max_gb must not be negative")

    @property
    def is_set(self) -> bool:
        """Whether anything is ever deleted."""
        return self.max_days > 0 or self.max_gb > 0


@dataclass(frozen=True)
class MappingConfig:
    """All settings of the mapping service."""

    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    rates: LearningRates = field(default_factory=LearningRates)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    owner: OwnerConfig = field(default_factory=OwnerConfig)
    retention: RetentionConfig = field(default_factory=RetentionConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)

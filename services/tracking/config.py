"""The numbers of tracking, by step."""

from __future__ import annotations

from dataclasses import dataclass, field

from shared.errors import ConfigError
from shared.fabric import BusConfig


def _require_positive(config: object, *names: str) -> None:
    for name in names:
        if getattr(config, name) <= 0:
            raise ConfigError(f"{name} must be positive, got {getattr(config, name)}")


@dataclass(frozen=True)
class SurfaceConfig:
    """Points and normals from the depth grid."""

    stride_px: int = 4  # between samples at 640x480; grows with the image
    window_radius_px: int = 6  # of the plane fit, at 640x480
    min_depth_m: float = 0.2
    max_depth_m: float = 8.0  # far surfaces hold the rotation: 4 m was measured to cost it
    min_window_share: float = 0.5  # of the window's pixels that lie on the surface
    min_incidence_cos: float = 0.17  # 80 degrees
    max_slope: float = 4.0  # of a surface within the window; a steeper step is an edge

    def __post_init__(self) -> None:
        _require_positive(self, "stride_px", "window_radius_px", "min_depth_m")
        if self.max_depth_m <= self.min_depth_m:
            raise ConfigError(f"max_depth_m must exceed min_depth_m, got {self.max_depth_m}")


@dataclass(frozen=True)
class RegistrationConfig:
    """Coarse-to-fine point-to-plane registration to the local map."""

    voxel_sizes_m: tuple[float, ...] = (0.20, 0.10, 0.05)
    sample_steps: tuple[int, ...] = (12, 8, 4)
    max_iterations: tuple[int, ...] = (8, 8, 8)
    min_normal_cos: float = 0.7
    depth_sigma_floor_m: float = 0.002
    depth_sigma_per_m2: float = 0.002  # sigma = floor + this * z^2
    kernel_width: float = 2.0  # of the robust kernel, in residual scales
    min_kernel_width: float = 0.1  # in depth sigmas: exact depth still meets rounded edges
    tolerances: tuple[float, ...] = (5e-3, 2e-3, 2e-4)  # of a step, metres and radians
    min_eigenvalue_share: float = 1e-4  # directions below it keep the prediction
    effective_share: float = 0.1  # residuals of neighbours are not independent
    model_sigma: float = 0.02  # floor of the residual scale, in depth sigmas
    turn_deg: float = 10.0  # of further starts, where none before led to a pose

    def __post_init__(self) -> None:
        levels = (self.voxel_sizes_m, self.sample_steps, self.max_iterations, self.tolerances)
        if len({len(values) for values in levels}) != 1 or not self.voxel_sizes_m:
            names = "voxel_sizes_m, sample_steps, max_iterations and tolerances"
            raise ConfigError(f"{names} must match in length")
        ratios = [size / self.voxel_sizes_m[-1] for size in self.voxel_sizes_m]
        if any(abs(ratio - round(ratio)) > 1e-6 for ratio in ratios):
            raise ConfigError("voxel_sizes_m must be multiples of the last")
        _require_positive(self, "depth_sigma_floor_m", "kernel_width", "effective_share")


@dataclass(frozen=True)
class OrbConfig:
    """Features and their matching to landmarks."""

    num_features: int = 1000
    num_detected: int = 2500  # before they are spread over cells
    cell_px: int = 40
    fast_threshold: int = 8
    faint_threshold: int = 3  # where few are found at the usual one: a dark or plain image
    few_features: int = 300
    num_levels: int = 8
    search_radius_px: float = 10.0
    few_matches: int = 40  # fewer are looked for once more, in a wider circle
    wide_radius_px: float = 30.0
    max_hamming_bits: int = 60
    ratio: float = 0.85
    max_hamming_bits_global: int = 64  # matching without a pose
    ratio_global: float = 0.8
    max_depth_spread: float = 0.03  # relative, around a keypoint whose depth is trusted
    noise_spreads: float = 1.5  # of a noisy sensor: times the spread that a quarter stay below
    max_noisy_depth_spread: float = 0.15  # beyond it the patch is torn, noisy or not
    max_feature_depth_m: float = 8.0

    def __post_init__(self) -> None:
        _require_positive(self, "num_features", "num_detected", "cell_px", "search_radius_px")


@dataclass(frozen=True)
class RefinementConfig:
    """Pose-only refinement on features, with the registration as prior."""

    pixel_sigma: float = 1.5  # at octave 0
    depth_sigma_floor_m: float = 0.005
    depth_sigma_per_m2: float = 0.004
    huber_sigma: float = 2.0
    rounds: int = 2
    iterations: int = 5
    outlier_chi2: float = 9.0
    max_relinearisations: int = 3  # of matches and registration around the refined pose

    def __post_init__(self) -> None:
        _require_positive(self, "pixel_sigma", "huber_sigma", "rounds", "max_relinearisations")


@dataclass(frozen=True)
class VerificationConfig:
    """When a pose is believed."""

    sure_inliers: int = 100  # enough of these, and nothing else is tried
    sure_inliers_near: int = 40  # where the pose is about what was predicted
    near_step_m: float = 0.05
    near_step_deg: float = 3.0
    sure_agreement: float = 0.85
    min_inliers: int = 15
    min_inlier_share: float = 0.25
    min_agreement: float = 0.6
    min_overlap: float = 0.15
    # Errors of neighbouring pixels go together. Squared errors were 1.1 and 2.6 times what the
    # information says on rendered sequences, 19 and 31 times on real ones (whose truth errs too).
    covariance_scale: float = 6.0
    depth_tolerance_m: float = 0.03
    depth_tolerance_per_m2: float = 0.01
    seen_min_inlier_share: float = 0.5  # without depth
    coarse_min_agreement: float = 0.85  # without features
    coarse_min_overlap: float = 0.08
    coarse_min_overlap_far: float = 0.25  # beyond a near step from the prediction
    coarse_max_step_m: float = 0.3  # from the prediction
    coarse_max_step_deg: float = 15.0
    explained_min_agreement: float = 0.95  # by geometry alone: no other start will do better
    explained_min_overlap: float = 0.4
    max_unexplained: float = 0.1  # of the frame, less in the map than as predicted: look on
    brief_lost_frames: int = 3  # after more, a pose nearby must be as sure as one anywhere
    max_step_m: float = 1.0
    max_step_deg: float = 50.0


@dataclass(frozen=True)
class MovingConfig:
    """What in a frame moves otherwise than the map."""

    grid_px: int = 4  # of the depth image that is split into surfaces, at 640x480
    max_jump: float = 0.05  # of a surface's depth from one cell of the grid to the next
    still_px: float = 1.5  # at 640x480; from where a keyframe saw the same feature
    still_depth: float = 0.02  # relative
    still_bits: int = 60
    min_still: int = 15  # features of a surface, to say that it goes with the camera
    min_still_share: float = 0.4
    min_free: int = 12  # points of a surface in free space, of every fourth that is seen
    min_free_share: float = 0.5
    min_share: float = 0.04  # of the frame's points: less does no harm
    max_share: float = 0.75  # beyond it there is nothing left to tell the pose by

    def __post_init__(self) -> None:
        _require_positive(self, "grid_px", "still_px", "min_still", "min_free")


@dataclass(frozen=True)
class RelocalizationConfig:
    """Pose from features alone."""

    min_matches: int = 12
    min_inliers: int = 10
    reprojection_px: float = 4.0
    iterations: int = 2000
    max_candidates: int = 5
    seed: int = 0
    spread_inliers: int = 40  # fewer than verification.sure_inliers will do where they lie in
    spread_cells: int = 8  # so many of 16 cells of the image: a repeated object fills fewer
    spread_inliers_colour: int = 80  # without depth to confirm them
    min_inlier_share_colour: float = 0.5


@dataclass(frozen=True)
class FeatureStartConfig:
    """Where to start, from features with depth, while the camera moves in large steps."""

    num_features: int = 500  # the best, whose descriptors are compared with all landmarks
    num_samples: int = 300  # of three pairs: one in thirty is right where a third of pairs are
    sample_px: float = 12.0  # depth of three points is that good
    inlier_px: float = 5.0
    min_inliers: int = 15

    def __post_init__(self) -> None:
        _require_positive(self, "num_features", "num_samples", "sample_px", "inlier_px")


@dataclass(frozen=True)
class LoopVerificationConfig:
    """When a keyframe is believed to show the place of an earlier one."""

    max_candidates: int = 2
    compared_features: int = 250  # the best, before all of them are matched without a pose
    min_alike: int = 12  # of these; up to 11 were measured where another place is seen
    min_inliers: int = 40
    min_inlier_share: float = 0.4
    min_agreement: float = 0.85
    min_overlap: float = 0.3
    unmoved_min_agreement: float = 0.95  # without features
    unmoved_min_overlap: float = 0.4
    unmoved_m: float = 0.02  # from the pose as tracked
    unmoved_deg: float = 0.6

    def __post_init__(self) -> None:
        _require_positive(self, "max_candidates", "compared_features", "min_inliers")
        _require_positive(self, "unmoved_m", "unmoved_deg")


@dataclass(frozen=True)
class KeyframeRuleConfig:
    """When a frame becomes a keyframe."""

    min_overlap: float = 0.75  # of its surface with the local map
    max_interval: int = 10  # frames, for mapping
    min_landmark_share: float = 0.35  # of its features with depth that match a landmark
    few_landmarks: int = 120  # fewer agree, while more features wait for a second view
    max_cloud_points: int = 12000
    min_points: int = 500  # with depth: less is no surface
    min_landmarks: int = 50  # that hold a keyframe without a surface
    max_std_m: float = 0.03  # of its pose, in the direction that is known least
    std_distance_m: float = 2.0  # of landmarks, beyond which it may be more in proportion
    max_std_deg: float = 1.5
    min_step_m: float = 0.02  # from the reference keyframe: less is the same view again
    min_turn_deg: float = 1.0
    max_turn_deg: float = 15.0
    max_step_share: float = 0.12  # of the median depth
    max_added_blur_px: float = 1.6  # at 640x480, beside the keyframes around: 6 px of motion
    # Beyond one of these a blurred keyframe is better than losing the camera.
    min_blurred_overlap: float = 0.4
    min_blurred_landmarks: int = 100
    max_blurred_turn_deg: float = 25.0  # from the reference, after one more turn like the last

    def __post_init__(self) -> None:
        _require_positive(self, "max_interval", "max_cloud_points", "max_added_blur_px")


@dataclass(frozen=True)
class BundleAdjustmentConfig:
    """Local bundle adjustment of a new keyframe's window."""

    iterations: int = 8  # 0: keyframes stay where they were tracked
    pixel_sigma: float = 1.5
    huber_sigma: float = 2.0
    outlier_chi2: float = 6.0  # one in twenty of the right observations exceeds it
    depth_sigma_floor_m: float = 0.003
    depth_sigma_per_m2: float = 0.003
    pose_prior_share: float = 1.0  # weight of the geometry that holds a window's poses

    def __post_init__(self) -> None:
        _require_positive(self, "pixel_sigma", "huber_sigma")
        if self.iterations < 0:
            raise ConfigError(f"iterations must not be negative, got {self.iterations}")


@dataclass(frozen=True)
class TriangulationConfig:
    """Landmarks from two keyframes, of features that have no depth."""

    epipolar_px: float = 1.5  # from the line that the other view gives, at octave 0
    min_parallax_deg: float = 1.0
    max_hamming_bits: int = 50
    ratio: float = 0.8

    def __post_init__(self) -> None:
        _require_positive(self, "epipolar_px", "min_parallax_deg", "max_hamming_bits", "ratio")


@dataclass(frozen=True)
class TrackingConfig:
    """All of the tracking service."""

    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    orb: OrbConfig = field(default_factory=OrbConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    moving: MovingConfig = field(default_factory=MovingConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    feature_start: FeatureStartConfig = field(default_factory=FeatureStartConfig)
    loop: LoopVerificationConfig = field(default_factory=LoopVerificationConfig)
    keyframe: KeyframeRuleConfig = field(default_factory=KeyframeRuleConfig)
    bundle_adjustment: BundleAdjustmentConfig = field(default_factory=BundleAdjustmentConfig)
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    context_cache: int = 8  # contexts kept, over all sessions
    concurrent_frames: int = 2
    query_timeout_s: float = 5.0
    map_patience_s: float = 0.03  # live: then the last neighbourhood that is cached must do

    def __post_init__(self) -> None:
        _require_positive(self, "context_cache", "concurrent_frames")
        _require_positive(self, "query_timeout_s", "map_patience_s")

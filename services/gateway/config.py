"""Settings of the gateway: limits, time-outs and sizes."""

from __future__ import annotations

from dataclasses import dataclass, field

from shared.errors import ConfigError
from shared.fabric import BusConfig


def _check_positive(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if value <= 0:
            raise ConfigError(f"{name} must be positive, got {value}")


@dataclass(frozen=True)
class LimitsConfig:
    """What a client may send and ask for."""

    max_message_bytes: int = 32 << 20  # an HTTP body, a WebSocket message, a gRPC message
    max_render_pixels: int = 4 << 20
    max_refine_iterations: int = 1_000_000
    max_connections: int = 512
    max_waiting_frames: int = 8  # of one offline session, beyond what its credits allow
    max_localizations: int = 8  # single images of one session that are searched for at a time
    max_path_frames: int = 3600  # of one path render, two minutes of video
    max_path_bytes: int = 1 << 30
    max_path_renders: int = 4  # at a time, and so many more files are kept

    def __post_init__(self) -> None:
        _check_positive(
            self,
            "max_message_bytes",
            "max_render_pixels",
            "max_connections",
            "max_waiting_frames",
            "max_localizations",
            "max_path_frames",
            "max_path_bytes",
            "max_path_renders",
        )


@dataclass(frozen=True)
class DispatchConfig:
    """The pool of tracking workers."""

    first_frame_timeout_s: float = 20.0  # a worker's first frame of a session fills its caches
    live_timeout_s: float = 6.0  # more than a worker waits for the map's owner
    offline_timeout_s: float = 30.0
    live_wait_s: float = 3.0  # how long a frame waits for a worker to appear
    offline_wait_s: float = 60.0
    patience_s: float = 0.25  # beside a worker that keeps silent for so long, another is asked,
    patience_ratio: float = 3.0  # and not before so many times what a frame takes at present
    quarantine_s: float = 5.0  # a worker that kept silent gets no frames for so long
    load_cap: float = 1.25  # sessions of one worker over the mean of all
    idle_s: float = 10.0  # a session without frames for so long loads no worker

    def __post_init__(self) -> None:
        _check_positive(self, "first_frame_timeout_s", "live_timeout_s", "offline_timeout_s")
        _check_positive(self, "live_wait_s", "offline_wait_s", "idle_s")
        _check_positive(self, "patience_s", "patience_ratio", "quarantine_s")
        if self.load_cap < 1.0:
            raise ConfigError(f"load_cap must be at least 1, got {self.load_cap}")


@dataclass(frozen=True)
class MappingConfig:
    """Questions to the owners of maps."""

    advance_timeout_s: float = 120.0  # an offline mapper delays its reply to bound its queue
    open_timeout_s: float = 60.0
    question_timeout_s: float = 30.0
    probe_timeout_s: float = 5.0  # whether an owner that went out of sight is still there
    export_timeout_s: float = 300.0
    reopen_wait_s: float = 60.0  # how long a session waits for a live mapper
    retry_s: float = 0.2
    live_entries: int = 256  # answered frames that a live session holds unacknowledged
    claim_wait_s: float = 1.0  # for the owner to say that a session is still ours
    keyframe_wait_s: float = 0.03  # a live session waits so long for a keyframe's acknowledgement,
    keyframe_wait_ratio: float = 2.0  # or so many times what that takes at present,
    keyframe_max_wait_s: float = 0.25  # and never longer

    def __post_init__(self) -> None:
        _check_positive(self, "advance_timeout_s", "question_timeout_s", "retry_s", "live_entries")
        _check_positive(self, "open_timeout_s", "probe_timeout_s", "export_timeout_s")
        _check_positive(self, "reopen_wait_s", "claim_wait_s", "keyframe_max_wait_s")


@dataclass(frozen=True)
class StreamConfig:
    """Frame and pose streams."""

    credit: int = 2  # frames in flight and waiting: one each
    live_unanswered: int = 64  # of a live stream; superseded ones are answered in order
    send_timeout_s: float = 5.0  # a client that does not read for so long is cut off,
    unread_s: float = 30.0  # and the kernel drops what it has not taken by then
    ping_interval_s: float = 30.0
    event_interval_s: float = 0.25  # between looks at a refinement that somebody watches
    live_interval_s: float = 0.1  # between looks at a session that somebody watches
    follow_interval_s: float = 1.0  # a view whose camera rests is drawn again so often
    ping_timeout_s: float = 120.0
    poses: int = 4096  # answered frames kept for `pose?t_ns=`
    max_gap_s: float = 1.0  # poses further apart are not interpolated between

    def __post_init__(self) -> None:
        _check_positive(self, "credit", "live_unanswered", "send_timeout_s", "unread_s")
        _check_positive(self, "ping_interval_s", "ping_timeout_s", "event_interval_s")
        _check_positive(self, "live_interval_s", "follow_interval_s", "poses", "max_gap_s")


@dataclass(frozen=True)
class JwtConfig:
    """JSON web tokens beside our own keys; off without a file."""

    key_file: str = ""  # the issuer's public key as PEM, or a JWK set
    issuer: str = ""
    audience: str = "pointslam"

    def __post_init__(self) -> None:
        if self.key_file and not (self.issuer and self.audience):
            raise ConfigError("access.jwt.key_file needs access.jwt.issuer and .audience too")


@dataclass(frozen=True)
class AccessConfig:
    """What one key may ask for, and from where; nothing of it holds with --insecure-local."""

    requests_per_s: float = 100.0  # HTTP requests, sockets opened, RPCs
    frames_per_s: float = 120.0  # four cameras at full rate
    burst_s: float = 2.0  # both rates may be saved up for so long
    ticket_s: float = 30.0  # life of a browser's ticket
    recheck_s: float = 5.0  # a stream ends so long after its key
    allowed_origins: tuple[str, ...] = ()  # of pages that are not the gateway's own
    jwt: JwtConfig = field(default_factory=JwtConfig)

    def __post_init__(self) -> None:
        _check_positive(self, "requests_per_s", "frames_per_s", "burst_s", "ticket_s", "recheck_s")


@dataclass(frozen=True)
class GatewayConfig:
    """All settings of the gateway."""

    limits: LimitsConfig = field(default_factory=LimitsConfig)
    dispatch: DispatchConfig = field(default_factory=DispatchConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    access: AccessConfig = field(default_factory=AccessConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    session_idle_s: float = 600.0  # a session that nobody uses for so long is forgotten here
    path_keep_s: float = 600.0  # the file of a path render may be fetched for so long
    drain_notice_s: float = 0.5  # at SIGTERM: not ready for so long before the door closes,
    drain_streams_s: float = 1.0  # then so long for the replies to frames that were taken,
    drain_s: float = 3.0  # so long for requests under way, and for what maps have not logged,
    drain_calls_s: float = 1.0  # and so long for calls over gRPC

    def __post_init__(self) -> None:
        _check_positive(self, "session_idle_s", "path_keep_s")

    @property
    def ends_within_s(self) -> float:
        """How long after SIGTERM the last of it ends: notice, streams, requests, calls, maps."""
        return self.drain_notice_s + self.drain_streams_s + 2.0 * self.drain_s + self.drain_calls_s

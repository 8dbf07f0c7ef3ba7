"""One run: a sequence through the gateway as a client would send it, then its scores."""

from __future__ import annotations

import math
import shutil
import tarfile
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pointslam.client import Client, Session
from pointslam.datasets import Sequence, open_sequence
from pointslam.evaluation import metrics as entries
from pointslam.evaluation.evaluate import evaluate_session, write_evaluation
from pointslam.evaluation.lpips import Lpips
from pointslam.evaluation.protocol import EvaluationOutput
from pointslam.launcher import LaunchOptions, Services
from pointslam.progress import progress_bar
from pointslam.refine import watch_refinement
from pointslam.run_folder import RunFolder, RunRecord
from pointslam.settings import RunSettings, read_settings
from pointslam.streaming import StreamOptions, StreamResult, stream_sequence
from shared.errors import ConfigError, UnavailableError
from shared.frames import HAS_POSE, TrackingStatus

MODES = ("offline", "live")


@dataclass(frozen=True)
class RunOptions:
    """What to run, and how. Without `gateway` the services are started for the run.

    A live run plays the recording, `speed` times as fast as it was taken. `lpips_weights` is a
    safetensors file; without it metrics.json has null for LPIPS.
    """

    sequence: Path
    out: Path
    mode: str = "offline"
    speed: float = 1.0
    max_frames: int | None = None
    refine: int = 0
    holdout: int = 8
    device: str = "auto"
    gateway: str | None = None
    seed: int = 0
    num_trackers: int = 2
    lpips_weights: Path | None = None
    settings: RunSettings = field(default_factory=RunSettings)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError(f"mode must be one of {', '.join(MODES)}, got {self.mode}")
        for name, low in (("refine", 0), ("holdout", 0), ("seed", 0), ("num_trackers", 1)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name} must be at least {low}, got {getattr(self, name)}")
        if self.holdout == 1:
            raise ConfigError("holdout 1 would keep every frame from training; 0 keeps none")
        if not 0.0 < self.speed < math.inf or (self.mode == "offline" and self.speed != 1.0):
            raise ConfigError(f"speed must be positive, and 1 offline, got {self.speed}")
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigError(f"max_frames must be positive, got {self.max_frames}")


class Gateway(Protocol):
    """Where to send frames, and what can be known of the services behind it."""

    @property
    def url(self) -> str:
        """Its HTTP address."""
        ...

    def check(self) -> None:
        """Raise if a service has ended."""
        ...

    def peak_rss_mb(self) -> dict[str, float] | None:
        """Peak memory by role, where the services are ours."""
        ...


@dataclass(frozen=True)
class RemoteGateway:
    """Somebody else's services."""

    url: str

    def check(self) -> None:
        """Nothing to look at from here."""

    def peak_rss_mb(self) -> dict[str, float] | None:
        """Unknown from here."""
        return None


@dataclass(frozen=True)
class _Mapped:
    """What the map's owner and the clock say after streaming and refinement."""

    info: dict[str, Any]
    total_s: float


def run_sequence(options: RunOptions) -> dict[str, Any]:
    """Run, score and write everything into `options.out`; returns the metrics.

    Raises:
        SequenceError: the sequence cannot be read.
        PointSlamError: a frame was refused or a service failed.
    """
    sequence = open_sequence(options.sequence, options.settings.sequence)
    lpips = _lpips(options.lpips_weights)
    folder = prepare_folder(options.out)
    with _gateway(options, folder) as gateway, Client(gateway.url) as client:
        session = client.create_session(sequence.calibration, mode=options.mode, seed=options.seed)
        streamed, mapped = _stream_and_map(session, sequence, options)
        record = _record(options, sequence, session, streamed)
        folder.write_record(record)
        export_map(session, folder)
        with progress_bar("scores", "view") as progress:
            output = EvaluationOutput(folder.renders, options.holdout, progress, lpips)
            evaluation = evaluate_session(session, sequence, output)
        metrics = {
            **_counts(record, sequence, streamed),
            **evaluation.entries(options.holdout),
            **_times(record, streamed, mapped),
            **entries.map_entries(mapped.info),
            "peak_rss_mb": entries.memory_entry(gateway.peak_rss_mb()),
            **entries.provenance(),
        }
    write_evaluation(folder, sequence, record, evaluation, metrics)
    return metrics


def evaluate_run(path: Path, lpips_weights: Path | None = None) -> dict[str, Any]:
    """Score a finished run again from its saved map; returns the new metrics.

    Raises:
        SequenceError: there is no run, or its sequence cannot be read any more.
        ConfigError: the weights of LPIPS cannot be read.
    """
    lpips = _lpips(lpips_weights)
    folder = RunFolder(path)
    record = folder.read_record()
    metrics = folder.read_metrics()
    sequence = open_sequence(record.sequence, record.sequence_options)
    with open_saved_session(folder, record) as session, progress_bar("scores", "view") as progress:
        output = EvaluationOutput(folder.renders, record.holdout, progress, lpips)
        evaluation = evaluate_session(session, sequence, output)
    metrics |= evaluation.entries(record.holdout)
    write_evaluation(folder, sequence, record, evaluation, metrics)
    return metrics


def _lpips(weights: Path | None) -> Lpips | None:
    return None if weights is None else Lpips.read(weights)


@contextmanager
def open_saved_session(folder: RunFolder, record: RunRecord) -> Iterator[Session]:
    """Services on a copy of a run's map, with its session taken up again."""
    settings = read_settings(None, record.settings).services
    with tempfile.TemporaryDirectory(prefix="pointslam-") as scratch:
        data = Path(scratch) / "data"
        shutil.copytree(folder.map, data)
        launch = LaunchOptions(data, folder.logs, 1, record.device, settings=settings)
        with Services(launch) as services, Client(services.url) as client:
            yield client.session(record.session)


@contextmanager
def _gateway(options: RunOptions, folder: RunFolder) -> Iterator[Gateway]:
    """The gateway that was named, or services of our own for as long as the run takes."""
    if options.gateway is not None:
        yield RemoteGateway(options.gateway)
        return
    with tempfile.TemporaryDirectory(prefix="pointslam-") as scratch:
        launch = LaunchOptions(
            data=Path(scratch),
            logs=folder.logs,
            num_trackers=options.num_trackers,
            device=options.device,
            settings=options.settings.services,
        )
        with Services(launch) as services:
            try:
                yield services
            except UnavailableError:
                services.check()  # says more, if one of them has ended
                raise


def prepare_folder(path: Path) -> RunFolder:
    """The output folder without what an earlier run left there.

    Raises:
        ConfigError: it cannot be made, or holds folders that would be removed and are no run's.
    """
    folder = RunFolder(path)
    for old in (folder.renders, folder.map):
        if old.exists() and not (folder.is_run() or folder.logs.is_dir()):
            raise ConfigError(
                f"--out {path}: {old.name}/ there is of no run; choose another folder"
            )
    folder.clear()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {path}: {error.strerror}") from None
    return folder


def export_map(session: Session, folder: RunFolder) -> None:
    """The session's snapshot unpacked into map/, and map.ply."""
    session.save()
    archive = folder.path / "map.tar"
    session.export("snapshot", archive)
    with tarfile.open(archive) as tar:
        # Python 3.11.2, Debian 12's own, knows no filters; the archive is our own gateway's.
        tar.extraction_filter = getattr(tarfile, "data_filter", lambda member, _: member)
        tar.extractall(folder.map)
    archive.unlink()
    session.export("ply", folder.ply)


def _stream_and_map(
    session: Session, sequence: Sequence, options: RunOptions
) -> tuple[StreamResult, _Mapped]:
    start = time.monotonic()
    count = min(len(sequence), options.max_frames or len(sequence))
    stream = StreamOptions(count, options.holdout, options.mode == "live", options.speed)
    streamed = stream_sequence(session, sequence, stream)
    with progress_bar("mapping", "frame") as progress:
        session.wait_until_mapped(progress)
    if options.refine > 0:
        session.start_refinement(options.refine)
        watch_refinement(session)
    session.interrupt()  # a live map would go on optimising while it is saved and scored
    return streamed, _Mapped(session.info(), time.monotonic() - start)


def _record(
    options: RunOptions, sequence: Sequence, session: Session, streamed: StreamResult
) -> RunRecord:
    worker_ms = streamed.worker_ms()
    return RunRecord(
        sequence=str(options.sequence.resolve()),
        sequence_options=options.settings.sequence,
        session=session.name,
        mode=options.mode,
        num_frames=min(len(sequence), options.max_frames or len(sequence)),
        holdout=options.holdout,
        seed=options.seed,
        device=options.device,
        settings=options.settings.services.words(),
        frame_seqs=tuple(worker_ms),
        frame_ms=tuple(worker_ms.values()),
        tracking_stages_ms=streamed.stages_ms(),
    )


def _counts(record: RunRecord, sequence: Sequence, streamed: StreamResult) -> dict[str, Any]:
    return {
        "sequence": sequence.name,
        "mode": record.mode,
        "seed": record.seed,
        "frames": record.num_frames,
        "tracked": sum(streamed.count(status) for status in HAS_POSE),
        "lost": streamed.count(TrackingStatus.LOST),
        "relocalized": streamed.count(TrackingStatus.RELOCALISED),
    }


def _times(record: RunRecord, streamed: StreamResult, mapped: _Mapped) -> dict[str, Any]:
    return {
        "tracking_ms": entries.tracking_entry(list(record.frame_ms), record.tracking_stages_ms),
        "wall_s": {
            "tracking": streamed.wall_s,
            "mapping": mapped.info["mapping_s"],
            "refinement": mapped.info["refinement_s"],
            "total": mapped.total_s,
        },
        "input_fps": record.num_frames / streamed.wall_s,
    }

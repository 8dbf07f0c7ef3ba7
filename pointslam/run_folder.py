"""The folder of a finished run: its files, and what is needed to score it again."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pointslam.datasets.base import SequenceOptions
from shared import codec
from shared.errors import InputError, SequenceError
from shared.se3 import Matrix, Pose


@dataclass(frozen=True)
class RunRecord:
    """How a run was made, and what was measured while it ran."""

    sequence: str
    sequence_options: SequenceOptions
    session: str
    mode: str
    num_frames: int
    holdout: int
    seed: int
    device: str
    settings: tuple[str, ...] = ()  # of the services, as --set words
    frame_seqs: tuple[int, ...] = ()
    frame_ms: tuple[float, ...] = ()  # inside the tracking worker, of frame_seqs
    tracking_stages_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RunFolder:
    """Names of everything that a run writes."""

    path: Path

    @property
    def metrics(self) -> Path:
        """All figures, JSON."""
        return self.path / "metrics.json"

    @property
    def report(self) -> Path:
        """The page with plots and pictures."""
        return self.path / "report.html"

    @property
    def renders(self) -> Path:
        """Pictures, rendered beside true."""
        return self.path / "renders"

    @property
    def map(self) -> Path:
        """A mapper's data folder with the session's snapshot."""
        return self.path / "map"

    @property
    def ply(self) -> Path:
        """The map as splats."""
        return self.path / "map.ply"

    @property
    def logs(self) -> Path:
        """What the services said."""
        return self.path / "logs"

    def trajectory(self, kind: str) -> Path:
        """The online or final trajectory, TUM."""
        return self.path / f"trajectory_{kind}.txt"

    def is_run(self) -> bool:
        """Whether a run was written here."""
        return self._record.is_file()

    def clear(self) -> None:
        """Remove what a run wrote, except its logs."""
        for folder in (self.renders, self.map):
            shutil.rmtree(folder, ignore_errors=True)
        trajectories = (self.trajectory("online"), self.trajectory("final"))
        for file in (self._record, self.metrics, self.report, self.ply, *trajectories):
            file.unlink(missing_ok=True)

    def write_record(self, record: RunRecord) -> None:
        """Keep how the run was made."""
        self._record.write_text(json.dumps(asdict(record)) + "\n")

    def read_record(self) -> RunRecord:
        """How the run was made.

        Raises:
            SequenceError: there is no run here, or its record is damaged.
        """
        try:
            return codec.from_plain(RunRecord, json.loads(self._record.read_text()))
        except OSError:
            raise SequenceError(self.path, "holds no run (no run.json)") from None
        except (ValueError, InputError) as error:
            raise SequenceError(self._record, f"is damaged ({error})") from None

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write metrics.json."""
        self.metrics.write_text(json.dumps(metrics, indent=2) + "\n")

    def read_metrics(self) -> dict[str, Any]:
        """Read metrics.json; SequenceError if it cannot be."""
        try:
            return json.loads(self.metrics.read_text())
        except (OSError, ValueError) as error:
            raise SequenceError(self.metrics, f"cannot be read ({error})") from None

    @property
    def _record(self) -> Path:
        return self.path / "run.json"


def tum_lines(stamps: list[str], poses: list[Matrix]) -> str:
    """A trajectory in TUM format, camera to world."""
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, T in zip(stamps, poses, strict=True):
        pose = Pose.from_matrix(T)
        p, q = pose.position, pose.orientation
        numbers = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        rows.append(" ".join([stamp, *(f"{n:.7f}" for n in numbers)]))
    return "\n".join(rows) + "\n"

"""Tracking on a bad day, in process: is it ever wrong without saying so?

python -m benchmarks.reliability SEQUENCE... [--elsewhere SEQUENCE] [--carried SHARE] [--frames N]
    [--json FILE]

Every seventh frame comes twice, every fiftieth is missing, every tenth has no depth and the others
lack a tenth of it, and for two seconds the camera is in another place. A pose is wrong where it is
more than 5 cm or 3 degrees from the truth, as seen from the keyframe that it is told relative to.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.disturbances import CarriedPlane, Plan, Sent, Sequence, disturbed
from benchmarks.tracking_run import StoreSource
from benchmarks.true_sequence import TrueSequence
from services.gateway.prior import next_prior
from services.mapping.keyframes.store import KeyframeStore
from services.tracking.config import TrackingConfig
from services.tracking.pipeline import track
from services.tracking.verification import Step, step_between
from shared.config import override, read_overrides
from shared.frames import HAS_POSE, Prior, TrackingStatus, TrackRequest
from shared.tracks import TrackResult

WRONG = Step(0.05, 3.0)


@dataclass(frozen=True)
class Answered:
    """What was sent, what came back, and how far off it was (None without a truth or a pose)."""

    sent: Sent
    result: TrackResult
    error: Step | None

    @property
    def is_wrong(self) -> bool:
        """Believed, and not where the camera was."""
        if self.result.status not in HAS_POSE:
            return False
        return self.error is None or not self.error.is_within(WRONG)


@dataclass(frozen=True)
class Row:
    """Figures of one run."""

    sequence: str
    frames: int
    tracked: int
    coarse_only: int
    relocalised: int
    lost: int
    keyframes: int
    wrong: int  # TRACKED or RELOCALISED
    wrong_coarse: int  # COARSE_ONLY: by one witness alone, and said so
    believed_elsewhere: int  # of those, while the camera was in another place
    bad_keyframes: int  # repeated, or made elsewhere
    frames_to_return: int | None  # until the first pose after the return; None: never


def run(
    sequence: Sequence, elsewhere: Sequence, plan: Plan, config: TrackingConfig
) -> list[Answered]:
    """Track the disturbed frames in order."""
    store = KeyframeStore()
    source = StoreSource(store, config)
    index_of: dict[int, int] = {}
    prior: Prior | None = None
    answers = []
    for sent in disturbed(sequence, elsewhere, plan):
        request = TrackRequest(
            session="reliability",
            epoch=1,
            map_revision=store.revision,
            calibration=sequence.calibration,
            frame=sent.frame,
            prior=prior,
            T_world_first=np.eye(4),
        )
        result = track(request, source, config)
        if result.keyframe is not None:
            store.insert(result.seq, result.t_ns, result.T_world_camera, result.keyframe)
        if sent.index is not None:
            index_of[result.seq] = sent.index
        answers.append(Answered(sent, result, _error(sequence, sent, result, index_of)))
        prior = next_prior(prior, sent.frame, _in_present_map(result, store))
    return answers


def _in_present_map(result: TrackResult, store: KeyframeStore) -> TrackResult:
    """The result with its pose where the map's latest correction puts it."""
    if result.status not in HAS_POSE:
        return result
    T_world_camera = store.pose(result.reference_seq) @ result.T_reference_camera
    return dataclasses.replace(result, T_world_camera=T_world_camera)


def _error(
    sequence: Sequence, sent: Sent, result: TrackResult, index_of: dict[int, int]
) -> Step | None:
    """Between the true and the told pose in the reference keyframe."""
    if sent.index is None or result.reference_seq not in index_of:
        return None
    true_reference = sequence.true_pose(index_of[result.reference_seq])
    told = true_reference @ result.T_reference_camera
    return step_between(sequence.true_pose(sent.index), told)


def row_of(name: str, answers: list[Answered], plan: Plan) -> Row:
    """Counts over a run."""
    coarse = TrackingStatus.COARSE_ONLY
    statuses = [answer.result.status for answer in answers]
    keyframes = [answer for answer in answers if answer.result.keyframe is not None]
    return Row(
        sequence=name,
        frames=len(answers),
        tracked=statuses.count(TrackingStatus.TRACKED),
        coarse_only=statuses.count(coarse),
        relocalised=statuses.count(TrackingStatus.RELOCALISED),
        lost=statuses.count(TrackingStatus.LOST),
        keyframes=len(keyframes),
        wrong=sum(a.is_wrong and a.result.status is not coarse for a in answers),
        wrong_coarse=sum(a.is_wrong and a.result.status is coarse for a in answers),
        believed_elsewhere=sum(a.is_wrong and a.sent.index is None for a in answers),
        bad_keyframes=sum(k.sent.is_repeat or k.sent.index is None for k in keyframes),
        frames_to_return=_frames_to_return(answers, plan),
    )


def _frames_to_return(answers: list[Answered], plan: Plan) -> int | None:
    returned = [a for a in answers if a.sent.frame.seq >= plan.away_from + plan.away_for]
    found = (n for n, answer in enumerate(returned, 1) if answer.result.status in HAS_POSE)
    return next(found, None)


def _arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", nargs="+", type=Path)
    parser.add_argument("--elsewhere", type=Path, help="the other place; else a sibling folder")
    parser.add_argument(
        "--carried",
        type=float,
        default=0.0,
        help="share of the image behind a board that goes along",
    )
    parser.add_argument("--frames", type=int, default=Plan.frames)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--verbose", action="store_true", help="name each wrong pose")
    return parser.parse_args(argv)


def _sibling(path: Path) -> Path:
    """Another sequence beside this one."""
    found = sorted(p.parent for p in path.resolve().parent.glob("*/associations.txt"))
    return next(other for other in found if other != path.resolve())


def main(argv: list[str]) -> int:
    """Run over the sequences named in argv; 1 where a wrong pose was believed."""
    arguments = _arguments(argv)
    cv2.setNumThreads(1)
    config = override(TrackingConfig(), read_overrides(None, arguments.set))
    away_from = min(Plan.away_from, 3 * arguments.frames // 5)
    plan = Plan(frames=arguments.frames, away_from=away_from)
    rows = []
    for path in arguments.sequences:
        elsewhere = TrueSequence(arguments.elsewhere or _sibling(path))
        sequence: Sequence = TrueSequence(path)
        if arguments.carried > 0.0:
            sequence = CarriedPlane(sequence, arguments.carried)
        answers = run(sequence, elsewhere, plan, config)
        rows.append(row_of(path.name, answers, plan))
        print(rows[-1], flush=True)
        if arguments.verbose:
            for answer in answers:
                if answer.is_wrong:
                    result = answer.result
                    print(f"  {result.seq} {result.status} {answer.error} {result.inliers}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    return 1 if any(row.wrong for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

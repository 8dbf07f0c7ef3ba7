"""What failures cost: processes killed and frozen while three clients stream at 15 frames/s.

`pointslam bench failover`: real services on this machine, two trackers and two mappers. Tells
frames and keyframes lost, the longest time without a reply, how long a map is without an owner,
and how far trajectory and picture are from those of a run in which nothing happened.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.aftermath import aftermath
from benchmarks.cluster import Cluster, running_cluster, wait_for
from benchmarks.players import Heard, Play, Player, play_all
from pointslam.client import Client, Session
from pointslam.datasets import open_sequence
from pointslam.datasets.base import Sequence
from pointslam.launcher import LaunchOptions
from pointslam.synth import Noise, SynthOptions, lit_room, record_scene
from shared.camera import Intrinsics
from shared.errors import PointSlamError
from shared.images import decode_colour

SMALL = Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
ROOM = SynthOptions(num_frames=60, num_views=1, noise=Noise.NONE, camera=SMALL)
CLIENTS = 3
FRAMES = {"live": 90, "offline": 45}  # six seconds of play, and three
FROZEN_S = 3.0
REFINED = 200  # iterations
QUALITY_VIEWS = (5, 20, 35)


@dataclass
class Costs:
    """What is measured; times in the units of their names, distances in metres."""

    frames: int = 0
    frames_lost: int = 0
    frames_superseded: int = 0
    keyframes_missing: int = 0
    reply_ms_median: float = 0.0  # when nothing happens
    reply_ms_max: float = 0.0  # the same
    gap_ms_undisturbed: float = 0.0
    gap_ms_tracker_killed: float = 0.0
    gap_ms_tracker_frozen: float = 0.0
    reply_ms_owner_killed: float = 0.0  # the slowest while the map has no owner
    owner_takeover_s: float = 0.0
    owner_takeover_frozen_s: float = 0.0
    trajectory_difference_m: float = 0.0
    psnr_db_before: float = 0.0
    psnr_db_after: float = 0.0  # with REFINED iterations of the new owner


@dataclass
class Trial:
    """A cluster, what is played to it, and what it has cost so far."""

    cluster: Cluster
    sequence: Sequence
    costs: Costs
    moments: np.random.Generator
    undisturbed: dict[int, np.ndarray] = field(default_factory=dict)

    def play(self, what: str, mode: str, harm: Callable[[list[str]], None]) -> list[Heard]:
        """Three clients play, harm is done at a random moment, and all is counted."""
        play = Play(self.sequence, mode, FRAMES[mode])
        players = play_all(self.cluster.url, {f"{what}-{i}": play for i in range(CLIENTS)})
        wait_for(lambda: all(len(p.heard.replies) > 15 for p in players.values()))
        time.sleep(self.moments.uniform(0.0, 1.0))
        harm(list(players))
        return [self._count(name, player) for name, player in players.items()]

    def _count(self, name: str, player: Player) -> Heard:
        heard, costs = player.finish(), self.costs
        after = aftermath(self.cluster.url, name, heard, self.undisturbed)
        costs.frames += len(heard.sent_s)
        costs.frames_lost += len(after.lost) + len(after.refused)
        costs.frames_superseded += heard.superseded()
        costs.keyframes_missing += len(after.missing)
        if name.startswith("offline"):
            difference_m = max(costs.trajectory_difference_m, after.difference_m)
            costs.trajectory_difference_m = difference_m
        with Client(self.cluster.url) as client:
            client.session(name).delete()
        return heard


def gap_ms(everyone: list[Heard], start_s: float, seconds: float) -> float:
    """The longest that any client was without a reply, of what overlaps some seconds."""
    return 1e3 * max(heard.longest_gap_s(start_s, start_s + seconds) for heard in everyone)


def slowest_ms(everyone: list[Heard], start_s: float, end_s: float) -> float:
    """The slowest reply to a frame that was sent in a span of time."""
    slow = [
        heard.at_s[seq] - sent_s
        for heard in everyone
        for seq, sent_s in heard.sent_s.items()
        if seq in heard.at_s and start_s <= sent_s <= end_s
    ]
    return 1e3 * max(slow, default=0.0)


def nothing_happens(trial: Trial) -> None:
    """The measure for everything else."""
    moments: list[float] = []
    everyone = trial.play("calm", "live", lambda _: moments.append(time.monotonic()))
    latencies = np.concatenate([heard.latencies_s() for heard in everyone])
    trial.costs.reply_ms_median = 1e3 * float(np.median(latencies))
    trial.costs.reply_ms_max = 1e3 * float(latencies.max())
    trial.costs.gap_ms_undisturbed = gap_ms(everyone, moments[0], 3.0)
    play = Play(trial.sequence, "offline", FRAMES["offline"], rate_hz=1000.0)
    trial.undisturbed = play_all(trial.cluster.url, {"alone": play})["alone"].finish().poses()


def tracker_killed(trial: Trial) -> None:
    """kill -9; with three sessions, each of two trackers is busy."""
    moments: list[float] = []

    def harm(_: list[str]) -> None:
        moments.append(time.monotonic())
        trial.cluster.kill("tracker-0")

    everyone = trial.play("tracker-killed", "live", harm)
    trial.costs.gap_ms_tracker_killed = gap_ms(everyone, moments[0], 2.0)
    trial.cluster.start("tracker-0")


def tracker_frozen(trial: Trial) -> None:
    """Frozen for some seconds, then woken."""
    moments: list[float] = []

    def harm(_: list[str]) -> None:
        moments.append(time.monotonic())
        trial.cluster.freeze("tracker-1")
        time.sleep(FROZEN_S)
        trial.cluster.wake("tracker-1")

    everyone = trial.play("tracker-frozen", "live", harm)
    trial.costs.gap_ms_tracker_frozen = gap_ms(everyone, moments[0], FROZEN_S + 1.0)


def owner_of(cluster: Cluster, name: str) -> str:
    """The mapper that serves a session's map."""
    with Client(cluster.url) as client:
        return client.session(name).info()["mapper"]


def seconds_until_taken_over(cluster: Cluster, name: str, owner: str, start_s: float) -> float:
    """From a moment until another mapper answers for a map."""
    wait_for(lambda: owner_of(cluster, name) != owner)
    return time.monotonic() - start_s


def owner_killed(trial: Trial) -> None:
    """kill -9 of a mapper; clients stream on, the other mapper takes the maps up."""
    span: list[float] = []

    def harm(names: list[str]) -> None:
        owner = owner_of(trial.cluster, names[0])
        start_s = time.monotonic()
        trial.cluster.kill(owner)
        takeover_s = seconds_until_taken_over(trial.cluster, names[0], owner, start_s)
        trial.costs.owner_takeover_s = takeover_s
        span.extend((start_s, start_s + takeover_s))
        trial.cluster.start(owner)

    everyone = trial.play("owner-killed", "live", harm)
    trial.costs.reply_ms_owner_killed = slowest_ms(everyone, *span)


def owner_frozen(trial: Trial) -> None:
    """A mapper frozen past its lease, offline: nothing may be answered that is not in the log."""

    def harm(names: list[str]) -> None:
        owner = owner_of(trial.cluster, names[0])
        start_s = time.monotonic()
        trial.cluster.freeze(owner)
        takeover_s = seconds_until_taken_over(trial.cluster, names[0], owner, start_s)
        trial.costs.owner_takeover_frozen_s = takeover_s
        trial.cluster.wake(owner)

    trial.play("offline-owner-frozen", "offline", harm)


def everything_killed(trial: Trial) -> None:
    """A tracker, the owner in the middle of a snapshot, the router and the gateway, one by one."""
    cluster = trial.cluster

    def harm(names: list[str]) -> None:
        owner = owner_of(cluster, names[0])
        saving = threading.Thread(target=_save, args=(cluster, names[0]), daemon=True)
        saving.start()
        for victim in ("tracker-1", owner, "router", "gateway-0"):
            cluster.kill(victim)
            cluster.start(victim)
        saving.join()

    trial.play("offline-all-killed", "offline", harm)


def _save(cluster: Cluster, name: str) -> None:
    with Client(cluster.url) as client:
        try:
            client.session(name).save()
        except PointSlamError:
            return  # whoever was to save it was killed


def picture_after_takeover(trial: Trial) -> None:
    """The map's picture before its owner is killed, and of the next one after some iterations."""
    cluster = trial.cluster
    play = Play(trial.sequence, "offline", FRAMES["offline"], rate_hz=1000.0)
    play_all(cluster.url, {"picture": play})["picture"].finish()
    with Client(cluster.url) as client:
        session = client.session("picture")
        session.refine(2 * REFINED)
        trial.costs.psnr_db_before = psnr_db(session, trial.sequence)
        owner = owner_of(cluster, "picture")
        cluster.kill(owner)
        session.refine(REFINED)
        trial.costs.psnr_db_after = psnr_db(session, trial.sequence)
        session.delete()
    cluster.start(owner)


def psnr_db(session: Session, sequence: Sequence) -> float:
    """Mean over some frames' views."""
    scores = []
    for index in QUALITY_VIEWS:
        frame = sequence.frame(index)
        assert frame.T_world_camera is not None
        shown = session.render(frame.T_world_camera).rgb.astype(float)
        true = decode_colour(frame.rgb, SMALL).astype(float)
        scores.append(10 * np.log10(255.0**2 / np.mean((shown - true) ** 2)))
    return float(np.mean(scores))


def measure(folder: Path, seed: int) -> Costs:
    """Everything, one failure after another, on one set of services."""
    record_scene(folder / "room", lit_room(0), ROOM)
    options = LaunchOptions(folder, folder, num_trackers=2, num_mappers=2, device="cpu")
    with running_cluster(folder, options) as cluster:
        sequence = open_sequence(folder / "room")
        trial = Trial(cluster, sequence, Costs(), np.random.default_rng(seed))
        nothing_happens(trial)
        for fail in (tracker_killed, tracker_frozen, owner_killed, owner_frozen):
            fail(trial)
        everything_killed(trial)
        picture_after_takeover(trial)
    return trial.costs


def main(argv: list[str]) -> int:
    """Measure and print; exit code 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of failure")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        costs = measure(Path(folder), arguments.seed)
    if arguments.json:
        print(json.dumps(asdict(costs)))
    else:
        for name, value in asdict(costs).items():
            print(f"{name:24} {value:10.4g}")
    return 1 if costs.frames_lost or costs.keyframes_missing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

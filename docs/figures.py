"""Draws the figures of docs/explanation from a run's folder.

    python docs/figures.py RUN [--frame 156]        RUN of `pointslam run SEQUENCE --out RUN`

Its map is taken up again and rendered, so what the pages show is what a run leaves behind.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pointslam.datasets import open_sequence
from pointslam.datasets.base import Sequence
from pointslam.datasets.lists import read_trajectory
from pointslam.evaluation.trajectory import align
from pointslam.run import open_saved_session
from pointslam.run_folder import RunFolder
from services.gateway.colour_maps import picture
from shared.images import decode_colour
from shared.se3 import transform

FOLDER = Path(__file__).resolve().parent / "explanation"
_WIDTH = 480  # px of each view
_QUALITY = 85


def main() -> None:
    """Draw all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frame", type=int, default=156, help="that is shown beside its render")
    arguments = parser.parse_args()
    folder = RunFolder(arguments.run)
    record = folder.read_record()
    sequence = open_sequence(record.sequence, record.sequence_options)
    draw_trajectory(folder, sequence)
    with open_saved_session(folder, record) as session:
        pose = session.trajectory()[arguments.frame]
        reply = session.render(pose.T_map_camera_final, appearance_t_ns=pose.t_ns)
    frame = sequence.frame(arguments.frame)
    recorded = decode_colour(frame.rgb, sequence.calibration.colour.intrinsics)
    layers = [picture(reply, layer).rgb for layer in ("colour", "depth", "confidence")]
    write_views([recorded, *layers])


def draw_trajectory(folder: RunFolder, sequence: Sequence) -> None:
    """The final trajectory over the truth, and how far it is from it along the way."""
    poses = read_trajectory(folder.trajectory("final"))
    estimated = {pose.t_ns: pose.T_world_camera for pose in poses}
    truth = {sequence.frame(i).t_ns: sequence.truth(i) for i in range(len(sequence))}
    pairs = [(estimated[t], T) for t, T in truth.items() if t in estimated and T is not None]
    ours, theirs = (np.stack(side) for side in zip(*pairs, strict=True))
    T_truth_estimated = align(ours, theirs)
    ours = transform(T_truth_estimated, ours[:, :3, 3])
    theirs = theirs[:, :3, 3]
    save_trajectory(ours, theirs)


def save_trajectory(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> None:
    """As an SVG, seen along the direction in which the camera moved least."""
    plane = np.linalg.svd(theirs - theirs.mean(axis=0), full_matrices=False)[2][:2].T
    matplotlib.rcParams["svg.hashsalt"] = "pointslam"  # the same figure has the same bytes
    figure = Figure((8.4, 3.6), layout="constrained")
    path, error = figure.subplots(1, 2)
    path.plot(*(theirs @ plane).T, color="0.7", linewidth=5, label="truth")
    path.plot(*(ours @ plane).T, color="tab:blue", linewidth=1.2, label="estimated")
    path.set_aspect("equal", adjustable="datalim")
    path.set(title="In the plane of most motion", xlabel="m", ylabel="m")
    path.legend(fontsize="small")
    error.plot(1e3 * np.linalg.norm(ours - theirs, axis=1), color="tab:blue", linewidth=1.0)
    error.set(title="Distance from the truth", xlabel="frame", ylabel="mm", ylim=(0, None))
    figure.savefig(FOLDER / "trajectory.svg", metadata={"Date": None})


def write_views(views: list[NDArray[np.uint8]]) -> None:
    """Recorded, rendered, depth and confidence, two by two, as a JPEG."""
    height = round(_WIDTH * views[0].shape[0] / views[0].shape[1])
    small = [cv2.resize(view, (_WIDTH, height), interpolation=cv2.INTER_AREA) for view in views]
    rows = np.vstack([np.hstack(small[:2]), np.hstack(small[2:])])
    file = str(FOLDER / "views.jpg")
    cv2.imwrite(file, rows[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


if __name__ == "__main__":
    main()

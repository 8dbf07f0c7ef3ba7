"""The command `pointslam render-path`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from shared.path_renders import PathKind, PathRenderRequest

_KINDS = [str(kind) for kind in PathKind if kind is not PathKind.POSES]


def add_render_path(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    standard = PathRenderRequest()
    parser.add_argument("source", metavar="DIR|SESSION", help="a run's folder, or a session")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.webm|.mp4|.zip")
    parser.add_argument(
        "--path",
        default=str(standard.path),
        metavar="PATH",
        help=f"{', '.join(_KINDS)}, or a TUM file of poses to pass through",
    )
    parser.add_argument(
        "--frames", type=int, metavar="N", help=f"{standard.frames}, or as many as the file's poses"
    )
    parser.add_argument("--fps", type=float, default=standard.fps)
    parser.add_argument("--width", type=int, metavar="PX", help="else the session's camera")
    parser.add_argument("--layer", choices=["colour", "depth", "confidence"], default="colour")
    parser.add_argument("--turn-deg", type=float, default=standard.turn_deg, help="of an orbit")
    parser.add_argument("--lossless", action="store_true", help="PNG in the .zip instead of JPEG")
    parser.add_argument("--gateway", metavar="URL", default="http://127.0.0.1:8080")
    parser.set_defaults(command=_render_path)


def _render_path(arguments: argparse.Namespace) -> None:
    from pointslam.render_path import format_of, poses_in, render_source

    is_kind = arguments.path in _KINDS
    poses = () if is_kind else poses_in(Path(arguments.path))
    request = PathRenderRequest(
        path=PathKind(arguments.path) if is_kind else PathKind.POSES,
        poses=poses,
        frames=arguments.frames or len(poses) or PathRenderRequest.frames,
        fps=arguments.fps,
        format=format_of(arguments.out, arguments.lossless),
        layer=arguments.layer,
        width=arguments.width,
        turn_deg=arguments.turn_deg,
    )
    status = render_source(arguments.source, request, arguments.gateway, arguments.out)
    sys.stdout.write(f"{arguments.out}: {status.frames_done} pictures\n")

"""The command `pointslam client`: a camera or a recording to a running gateway."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from shared.camera import Intrinsics
from shared.errors import ConfigError

if TYPE_CHECKING:
    from pointslam.bridges import Source


def add_client(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    kinds = parser.add_subparsers(required=True, metavar="SOURCE")
    helps = {
        "folder": "a recorded sequence, at its own pace",
        "mcap": "an MCAP recording, at its own pace",
        "video": "colour alone: found in the map of a session",
        "realsense": "an Intel RealSense camera",
        "record3d": "an iPhone or iPad over USB",
    }
    for name, text in helps.items():
        kind = kinds.add_parser(name, help=text)
        kind.set_defaults(command=_client, kind=name)
        kind.add_argument("--gateway", metavar="URL", default="http://127.0.0.1:8080")
        is_video = name == "video"
        kind.add_argument("--session", metavar="NAME", required=is_video, help="new, or gone on")
        if name in ("folder", "mcap", "video"):
            kind.add_argument("path", type=Path, metavar="PATH")
        if name == "realsense":
            kind.add_argument("--serial", metavar="NUMBER")
        if is_video:
            kind.add_argument("--intrinsics", metavar="FX,FY,CX,CY,WIDTH,HEIGHT")
        else:
            kind.add_argument("--record", type=Path, metavar="FILE.mcap")
            kind.add_argument(
                "--watch",
                action="store_true",
                help="be found in the map of --session and followed; nothing of it changes",
            )


def _client(arguments: argparse.Namespace) -> None:
    from pointslam.bridges import StreamRequest, localize_video, stream_source

    def say(text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    record = getattr(arguments, "record", None)
    watches = getattr(arguments, "watch", False)
    if watches and arguments.session is None:
        raise ConfigError("--watch needs --session")
    request = StreamRequest(arguments.gateway, arguments.session, record, watches)
    if arguments.kind == "video":
        localize_video(arguments.path, _intrinsics(arguments.intrinsics), request, say)
    else:
        stream_source(_source(arguments), request, say)


def _source(arguments: argparse.Namespace) -> Source:
    if arguments.kind == "realsense":
        from pointslam.bridges.realsense import RealSense

        return RealSense(arguments.serial)
    if arguments.kind == "record3d":
        from pointslam.bridges.record3d import Record3D

        return Record3D()
    from pointslam.bridges import RecordedSource
    from pointslam.datasets import open_sequence

    return RecordedSource(open_sequence(arguments.path))


def _intrinsics(text: str | None) -> Intrinsics | None:
    if text is None:
        return None
    words = text.split(",")
    try:
        fx, fy, cx, cy = (float(word) for word in words[:4])
        width, height = (int(word) for word in words[4:])
    except ValueError:
        raise ConfigError(f"--intrinsics must be six numbers, got {text!r}") from None
    return Intrinsics(fx, fy, cx, cy, width, height)

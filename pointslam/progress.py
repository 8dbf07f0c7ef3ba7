"""Progress bars on standard error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

Progress = Callable[[int, int], None]  # done, of so many


def open_bar(label: str, unit: str, total: int | None = None) -> tqdm:
    """A bar; a context manager. Where nobody watches (a log) it speaks every ten seconds."""
    interval_s = 0.1 if sys.stderr.isatty() else 10.0
    return tqdm(desc=label, unit=unit, total=total, mininterval=interval_s, dynamic_ncols=True)


@contextmanager
def progress_bar(label: str, unit: str = "it") -> Iterator[Progress]:
    """A bar whose length is told with the first step."""
    with open_bar(label, unit) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step


def describe(info: dict[str, Any], state: str) -> str:
    """What a bar says of a map: state, anchors, PSNR."""
    anchors = info["primary_anchors"] + info["secondary_anchors"]
    psnr_db = info["psnr_db"]
    quality = "" if psnr_db is None else f", {psnr_db:.1f} dB"
    return f"{state}, {info['keyframes']} keyframes, {anchors} anchors{quality}"

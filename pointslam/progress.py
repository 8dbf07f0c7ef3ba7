"""Progress bars on standard error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

Progress = Callable[[int, int], None]  # done, of so many


@contextmanager
def progress_bar(label: str, unit: str = "it") -> Iterator[Progress]:
    """A bar whose length is told with the first step."""
    with tqdm(desc=label, unit=unit, dynamic_ncols=True, leave=True) as bar:

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

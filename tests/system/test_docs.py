"""Commands in the documentation run as they are printed, with services up."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if "```sh\n" in page.read_text())
TO_GATEWAY = ("client", "refine")


def commands(page: Path) -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
    return [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]


def with_gateway(words: list[str], url: str, folder: Path) -> list[str]:
    """Name the gateway where the default is meant: of a session, not of a run's folder."""
    is_session = words[1] in ("export", "render-path") and not (folder / words[2]).is_dir()
    return [*words, "--gateway", url] if words[1] in TO_GATEWAY or is_session else words


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """The recording that the tutorial makes; the other pages use it."""
    folder = tmp_path_factory.mktemp("docs") / "room"
    run(["pointslam", "synth", str(folder), "--frames", "40"], folder.parent)
    return folder


def run(words: list[str], folder: Path) -> None:
    assert words[0] == "pointslam"
    program = [sys.executable, "-m", "pointslam.cli", *words[1:]]
    done = subprocess.run(program, cwd=folder, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, f"{shlex.join(words)}: {done.stderr[-2000:]}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_commands_of_a_page_run_in_order(page, room, services, tmp_path):
    if page.name != "tutorial.md":
        (tmp_path / "room").symlink_to(room)

    for words in commands(page):
        run(with_gateway(words, services.url, tmp_path), tmp_path)

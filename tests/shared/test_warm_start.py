import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

_PROGRAM = """
import os, sys, threading
import numba
from shared.service import setup_logging, stop_event
from shared.warm_start import warm_start

@numba.njit(cache=sys.argv[1] == "kept")
def kernel(x):
    return x + 1

print("begins", os.getpid(), flush=True)
setup_logging()
stop = stop_event()
if sys.argv[2:] == ["told-to-end"]:
    os.kill(os.getpid(), {terminate})
warm_start(lambda: kernel(1), stop)
print("serves", *sys.argv[1:], stop.is_set(), flush=True)
"""


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "program.py"
    path.write_text(_PROGRAM.format(terminate=int(signal.SIGTERM)))
    return path


def _run(program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[2]),
        "NUMBA_CACHE_DIR": str(program.parent / "cache"),
    }
    command = [sys.executable, str(program), *arguments]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=True
    )


def test_a_process_that_compiled_begins_anew_as_the_same_process(program: Path):
    begun, anew, serves = _run(program, "kept").stdout.splitlines()
    assert begun == anew
    assert serves == "serves kept False"


def test_a_process_that_finds_its_kernels_compiled_begins_once(program: Path):
    _run(program, "kept")
    lines = _run(program, "kept").stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["begins", "serves"]


def test_a_process_begins_anew_once_where_kernels_cannot_be_kept_and_says_so(program: Path):
    done = _run(program, "lost")
    assert done.stdout.count("begins") == 2
    assert done.stderr.count("set NUMBA_CACHE_DIR") == 1


def test_a_process_that_is_told_to_end_while_it_compiles_ends(program: Path):
    lines = _run(program, "kept", "told-to-end").stdout.splitlines()
    assert lines[1:] == ["serves kept told-to-end True"]

"""The committed code under shared/wire is what proto/generate.sh makes of proto/."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROTOS = sorted((ROOT / "proto" / "pointslam" / "v1").glob("*.proto"))


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    out = tmp_path_factory.mktemp("wire")
    command = [ROOT / "proto" / "generate.sh", str(out)]
    subprocess.run(command, check=True, env={"PYTHON": sys.executable, "PATH": "/usr/bin:/bin"})
    return {path.name: path.read_text() for path in out.iterdir()}


def test_the_committed_code_is_fresh(fresh):
    committed = {path.name: path.read_text() for path in (ROOT / "shared/wire").glob("*_pb2*")}

    assert sorted(committed) == sorted(fresh)
    assert [name for name, text in committed.items() if text != fresh[name]] == []


def test_every_call_has_request_and_response_types_of_its_own():
    calls = [
        match
        for path in PROTOS
        for match in re.findall(
            r"rpc (\w+)\((?:stream )?(\w+)\) returns \((?:stream )?(\w+)\)", path.read_text()
        )
    ]

    assert len(calls) == 13
    assert all((rq, rs) == (f"{name}Request", f"{name}Response") for name, rq, rs in calls)


@pytest.mark.parametrize("path", PROTOS, ids=lambda path: path.stem)
def test_every_file_is_of_the_versioned_package(path):
    assert "package pointslam.v1;" in path.read_text()

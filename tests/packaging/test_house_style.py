"""The budget of the house, measured: caps on the tail of functions, files and arguments."""

import ast
import re
import statistics
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("services", "shared", "pointslam", "benchmarks")
SOURCES = [
    path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
    if "_pb2" not in path.name
]


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{path.relative_to(ROOT)}:{node.name}", node


def body_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    body = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1


def test_no_function_is_longer_than_60_lines():
    assert [name for name, node in functions() if body_lines(node) > 60] == []


def test_half_of_all_functions_are_at_most_8_lines_and_nine_in_ten_at_most_25():
    lengths = sorted(body_lines(node) for _, node in functions())

    assert statistics.median(lengths) <= 8
    assert lengths[int(0.9 * len(lengths))] <= 25


def test_no_file_is_longer_than_300_lines():
    lengths = {str(p.relative_to(ROOT)): p.read_text().count("\n") for p in SOURCES}

    assert {name: rows for name, rows in lengths.items() if rows > 300} == {}


def test_every_module_says_what_it_is():
    missing = [p for p in SOURCES if p.read_text().strip() and not _docstring(p)]

    assert missing == []


def _docstring(path: Path) -> str | None:
    return ast.get_docstring(ast.parse(path.read_text()))


def test_nothing_is_left_for_later():
    unfinished = re.compile(r"TODO|FIXME|XXX|NotImplementedError")

    assert [p for p in SOURCES if unfinished.search(p.read_text())] == []


def test_files_are_not_named_after_nothing():
    vague = {"utils", "util", "helpers", "helper", "misc", "common", "manager", "data"}

    assert [p for p in SOURCES if p.stem in vague] == []

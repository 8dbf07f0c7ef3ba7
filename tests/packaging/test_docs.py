"""The documentation keeps up with the code."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


@pytest.fixture(scope="module")
def fresh(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    script = [sys.executable, str(ROOT / "docs" / "generate.py"), str(folder)]
    subprocess.run(script, check=True, cwd=ROOT, env={"PYTHONPATH": str(ROOT)})
    return folder


@pytest.mark.parametrize("name", ["settings.md", "routes.md", "metrics.md"])
def test_a_page_made_of_the_code_is_fresh(fresh, name):
    committed = (ROOT / "docs" / "reference" / name).read_text()

    assert committed == (fresh / name).read_text(), "run python docs/generate.py"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_to_a_file_leads_to_one(page):
    links = re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text())

    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_setting_that_is_named_exists(page):
    known = (ROOT / "docs" / "reference" / "settings.md").read_text()
    pattern = r"\b((?:tracking|mapping|gateway|router|sequence)\.[a-z_.]+)="
    named = re.findall(pattern, page.read_text())

    assert [key for key in named if f"`{key}`" not in known] == []

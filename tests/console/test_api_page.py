"""The page of the API: it describes every route, and loads nothing from elsewhere."""

from __future__ import annotations

import httpx
import pytest

from benchmarks.local_gateway import PATIENCE, local_gateway

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def page(browser, pictures):
    with local_gateway(1, *PATIENCE) as gateway:
        browser.resize(1280, 900)
        browser.forget()
        browser.open(f"{gateway.url}/docs")
        browser.wait_for("location.pathname === '/docs' && document.body?.dataset.ready === 'true'")
        browser.wait_for("document.querySelectorAll('.opblock').length > 0")
        yield browser, gateway
        browser.screenshot(pictures / "api.jpg")
        browser.forget()


def test_every_operation_is_shown(page):
    browser, gateway = page
    paths = httpx.get(f"{gateway.url}/openapi.json").json()["paths"]

    shown = browser.run("document.querySelectorAll('.opblock').length")

    assert shown == sum(len(operations) for operations in paths.values())


def test_nothing_comes_from_elsewhere_and_nothing_is_an_error(page):
    browser, gateway = page

    names = browser.run("performance.getEntriesByType('resource').map((r) => r.name)")

    assert [name for name in names if not name.startswith((gateway.url, "data:", "blob:"))] == []
    assert browser.errors == []


def test_a_key_can_be_entered(page):
    browser, _ = page

    browser.click(".btn.authorize")

    browser.wait_for("/bearer/i.test(document.querySelector('.modal-ux')?.innerText)")

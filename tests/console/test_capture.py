"""The capture page: a browser's camera, found or not in a map, on a gateway with stand-ins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.local_gateway import PATIENCE, local_gateway
from pointslam.client import Client
from shared import images
from shared.camera import Calibration, Camera, Intrinsics

pytestmark = pytest.mark.system

CALIBRATION = Calibration(Camera(Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)), depth_scale=1000.0)
RGB, DEPTH = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 1500, np.uint16)


@pytest.fixture(scope="module")
def gateway(browser):
    with local_gateway(1, *PATIENCE) as running, Client(running.url) as client:
        while not client.ready():
            pass
        browser.forget()
        yield running
        browser.forget()


def open_capture(browser, gateway):
    browser.open(f"{gateway.url}/capture")
    browser.wait_for("location.pathname === '/capture' && document.body?.dataset.ready === 'true'")


def test_without_a_map_it_says_that_depth_is_needed(browser, gateway):
    open_capture(browser, gateway)

    assert browser.text("#note").startswith("Depth is needed to make a map")
    assert "pointslam client realsense" in browser.text("#note")
    assert browser.run("document.getElementById('start').disabled")


def test_the_camera_is_looked_for_in_the_chosen_map(browser, gateway, pictures):
    with Client(gateway.url) as client:
        session = client.create_session(CALIBRATION, name="kitchen")
        session.track(RGB, DEPTH, 1)
        open_capture(browser, gateway)
        browser.click("#start")

        browser.wait_for("document.getElementById('answer').dataset.status")

    browser.screenshot(pictures / "capture.jpg")
    asked = gateway.trackers[0].images[-1].calibration.colour.intrinsics
    assert (asked.width, asked.height) == (640, 480)
    assert browser.text("#state") == "not found"
    assert "no keyframe looks like this" in browser.text("#answer")
    assert browser.errors == []


@pytest.fixture
def with_depth(browser):
    """The browser on a device whose camera comes with depth."""
    script = Path(__file__).with_name("xr_stand_in.js").read_text()
    added = browser.send("Page.addScriptToEvaluateOnNewDocument", source=script)
    yield browser
    browser.send("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    browser.forget()


def test_with_depth_its_frames_go_into_a_new_map(with_depth, gateway, pictures):
    browser = with_depth
    open_capture(browser, gateway)
    browser.run("document.getElementById('map').value = ''")
    browser.click("#start")
    browser.wait_for("document.getElementById('answer').dataset.status === 'TRACKED'")
    browser.wait_for("!document.getElementById('session-link').hidden")
    browser.screenshot(pictures / "capture_depth.jpg")
    browser.click("#start")
    browser.wait_for("document.getElementById('state').textContent === 'camera is off'")

    asked = gateway.trackers[0].requests[-1]
    size = asked.calibration.colour.intrinsics
    rgb = images.decode_colour(asked.frame.rgb, size)
    depth_m = images.decode_depth(asked.frame.depth, asked.calibration)
    assert (size.fx, size.fy, size.cx, size.cy) == (64.0, 60.0, 31.5, 23.5)
    assert rgb[4].mean(axis=0).argmax() == 0, "red is above"
    np.testing.assert_allclose(depth_m[:, [0, 63]].mean(axis=0), [1.0, 1.015], atol=1e-6)
    assert asked.frame.T_odom_camera is not None
    assert asked.frame.T_odom_camera.position.x > 0
    assert asked.frame.T_odom_camera.orientation.x == 1.0, "half a turn from GL's axes to OpenCV's"
    assert browser.errors == []

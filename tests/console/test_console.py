"""The console in a real browser, on real services, clicked through as a user would."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.system

STAGE = "document.getElementById('stage').dataset"


@pytest.fixture
def page(console):
    """The page on the room's session, as it is when it is opened."""
    console.page.resize(1440, 900)
    console.page.run("document.getElementById('stage').focus()")
    yield console.page


def pictures_of(page) -> int:
    return int(page.run(f"Number({STAGE}.pictures ?? 0)"))


def wait_for_newer_picture(page, before: int) -> None:
    page.wait_for(f"Number({STAGE}.pictures ?? 0) > {before}")


def test_the_list_shows_the_session_and_how_it_goes(page):
    page.wait_for("document.querySelector('.session-list .name')?.textContent === 'room'")
    page.wait_for("/keyframes/.test(document.getElementById('session-list').textContent)")

    assert page.text("#gateway-state") == "1 tracker, 1 mapper"
    assert page.text("#session-name") == "room"


def test_the_exact_view_and_the_splats_are_shown_with_the_path_over_them(console, page):
    page.wait_for(f"{STAGE}.exact && {STAGE}.splats")
    page.wait_for("document.getElementById('exact').naturalWidth > 300")

    drawn = page.run(
        "(() => { const c = document.getElementById('marks');"
        " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        " return d.some((value, i) => i % 4 === 3 && value > 0); })()"
    )
    assert drawn or page.run("document.getElementById('follow').ariaPressed") == "true"
    console.picture("console_desktop_dark")


def test_the_camera_s_image_and_figures_are_shown(page):
    page.wait_for("document.getElementById('live').dataset.state === 'shown'")
    page.wait_for("/frame 59/.test(document.getElementById('live-facts').textContent)")

    assert page.run("document.getElementById('live-image').naturalWidth") == 160
    assert "Inliers" in page.text("#figures")


def test_orbiting_asks_for_new_views_and_ends_following(console, page):
    before = pictures_of(page)

    page.drag("#stage", 120, 30, at=0.25)
    wait_for_newer_picture(page, before)

    assert page.run("document.getElementById('follow').ariaPressed") == "false"
    page.click("#overview")
    wait_for_newer_picture(page, before + 1)
    console.picture("console_overview")


def test_keys_orbit_and_choose_what_is_shown(page):
    before = pictures_of(page)
    page.key("3")
    page.key("ArrowLeft")

    wait_for_newer_picture(page, before)

    assert page.run(f"{STAGE}.mode") == "exact"
    page.key("2")


@pytest.mark.parametrize("layer", ["depth", "confidence"])
def test_a_layer_is_shown_with_its_legend(console, page, layer):
    page.click(f"#layer [data-value={layer}]")

    page.wait_for("!document.getElementById('legend').hidden")
    page.wait_for(f"document.getElementById('legend-bar').dataset.layer === '{layer}'")
    console.picture(f"console_{layer}")
    page.click("#layer [data-value=colour]")


def test_splats_are_drawn_by_the_browser_too(console, page):
    page.wait_for(f"{STAGE}.splats")
    page.click("#mode [data-value=splats]")
    page.click("#points")

    page.wait_for("document.getElementById('points').ariaPressed === 'false'")
    page.wait_for("performance.getEntriesByType('resource').some((r) => /spark/.test(r.name))")
    console.picture("console_splats")
    page.click("#points")
    page.click("#mode [data-value=split]")


def test_a_keyframe_is_compared_with_the_render_of_its_view(console, page):
    page.wait_for("document.getElementById('pair').dataset.state === 'shown'")

    page.run(
        "(() => { const k = document.getElementById('compare-keyframe');"
        " k.value = 0; k.dispatchEvent(new Event('input')); })()"
    )
    page.wait_for("document.getElementById('compare-seq').textContent === 'frame 0'")
    page.wait_for("document.getElementById('compare-render').naturalWidth > 300")

    assert page.run("document.getElementById('compare-image').naturalWidth") == 160


def test_saving_tells_of_it_and_is_an_event(page):
    page.click("#save")

    page.wait_for("/^Saved/.test(document.getElementById('action-note').textContent)")
    page.wait_for("document.querySelector('#events [data-kind=saved]') !== null")


def test_a_refinement_shows_how_far_it_is_and_ends(page):
    page.run("document.getElementById('refine-iterations').value = 20")
    page.click("#refine")

    page.wait_for("document.getElementById('job').dataset.state === 'done'")
    assert page.text("#job-text").startswith("Refined: 20 of 20")


@pytest.mark.parametrize("what", ["trajectory.tum", "map.ply"])
def test_a_file_is_downloaded(page, what):
    page.run(f"document.querySelector('[data-download=\"{what}\"]').click()")

    note = "document.getElementById('action-note').textContent"
    page.wait_for(f"/: [0-9.]+ [kM]?B\\.$/.test({note})")


@pytest.mark.parametrize("format", ["webm", "mp4"])
def test_a_video_of_a_path_is_played_by_the_browser(page, format):
    script = """(async () => {
      const asked = await fetch('/v1/sessions/room/renders', {method: 'POST',
        body: JSON.stringify({frames: 4, width: 64, format: '%s'})});
      const job = asked.headers.get('Location');
      await (await fetch(`${job}/events`)).text();
      const video = document.createElement('video');
      video.muted = true;
      const ended = new Promise((done, fail) => { video.onended = done; video.onerror = fail; });
      video.src = `${job}/file`;
      await video.play();
      await ended;
      return [video.videoWidth, video.getVideoPlaybackQuality().totalVideoFrames];
    })()"""

    assert page.run(script % format) == [64, 4]


def test_a_video_around_the_view_is_drawn_until_it_is_stopped(page):
    page.run("document.getElementById('tour-path').value = 'orbit'")
    page.click("#tour")

    text = "document.getElementById('tour-text').textContent"
    page.wait_for(f"/of 150 pictures/.test({text})")
    page.click("#tour-stop")
    page.wait_for(f"{text} === 'Video: stopped'")


def test_it_fits_a_phone_in_light_colours(console, page):
    page.resize(390, 844, "light")

    page.wait_for("innerWidth === 390")
    overflow = page.run("document.documentElement.scrollWidth - innerWidth")
    console.picture("console_phone_light")
    assert overflow <= 0


def test_a_session_that_does_not_exist_is_told_of(console, page):
    page.run("location.hash = 'nowhere'")

    page.wait_for("!document.getElementById('welcome').hidden")
    assert page.text("#welcome-title") == "There is no session nowhere"
    page.run("location.hash = 'room'")
    page.wait_for("!document.getElementById('session-view').hidden")


def test_nothing_of_it_was_an_error_and_it_is_small(page):
    bytes_of_the_page = page.run(
        "performance.getEntriesByType('resource').filter((r) => r.name.includes('/web/'))"
        ".reduce((sum, r) => sum + r.transferSize, 0)"
    )
    assert page.errors == []
    assert 500_000 < bytes_of_the_page < 6_000_000

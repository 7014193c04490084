"""The report in a real browser: layout, policy, sorting, colours, replay, print."""

import json

import numpy as np
import pytest
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from experiments.report.build import write_report
from experiments.run.store import ResultStore
from tests.helpers.browsers import DESK, PHONE, chromium, pixels, prefer, show
from tests.helpers.made_results import HOSTILE, case, folder_of, trace

HIDDEN_OVERFLOW = """
const outside = [];
for (const element of document.body.querySelectorAll("*")) {
  if (element.closest(".wide, pre, svg")?.matches(":not(svg)") && !element.matches(".wide, pre"))
    continue;
  const { right, width } = element.getBoundingClientRect();
  if (width > 0 && right > document.documentElement.clientWidth + 0.5)
    outside.push(`${element.tagName}.${element.className} to ${right}`);
}
return outside;
"""
"""Script that lists elements wider than the screen outside of scrolling boxes."""


def overflow(browser):
    """Return by how many px a page, all folds open, exceeds the screen, and which elements do."""
    browser.execute_script("document.querySelectorAll('details').forEach((one) => one.open = true)")
    measure = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
    return browser.execute_script(measure), browser.execute_script(HIDDEN_OVERFLOW)


@pytest.fixture(name="page", scope="module")
def fixture_page(tmp_path_factory):
    """Two agents on two paths, in simulation and with two seeds in real time, and odd names."""
    folder = tmp_path_factory.mktemp("results")
    store = ResultStore(folder)
    number = 0
    for agent in ("lpv-nmpc", "stanley"):
        for path in ("T1", "T2"):
            for conditions, seed in (("simulation", 0), ("realtime", 0), ("realtime", 1)):
                number += 1
                result = case(
                    number, agent, path, {"ale": 0.01 * number, "ale_sharp": 0.02 * number,
                    "share_sharp": 1.0}, conditions=conditions, seed=seed,
                )  # fmt: skip
                store.append({**result, "trace": trace(n=1201 + 40 * number, noise=0.01)})
    wide = {"excess_lateral_velocity": 0.4, "violated_lateral_velocity": 1.0}
    odd = case(90, HOSTILE, "a-rather-long-name-of-a-path.csv", wide, warnings=[HOSTILE * 3])
    store.append({**odd, "trace": trace(n=50)})
    store.append(case(91, "pid", "T2", status="failed", end=None, error=f"ValueError: {HOSTILE}"))
    store.write_manifest({"suite": "made"})
    return write_report(folder)


@pytest.fixture(name="browser", scope="module")
def fixture_browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.mark.parametrize("width", [PHONE, 768, DESK])
def test_it_opens_without_complaint_fetches_nothing_and_fits_the_screen(browser, page, width):
    browser.get_log("browser")
    browser.get_log("performance")
    show(browser, page, width)
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    sent = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [
        one["params"]["request"]["url"]
        for one in sent
        if one["method"] == "Network.requestWillBeSent"
    ]
    assert asked == [page.as_uri()]
    assert overflow(browser) == (0, [])


@pytest.mark.parametrize("width", [PHONE, 500, 768])
def test_figures_of_one_path_fit_beside_or_below_each_other(browser, tmp_path, width):
    folder_of(tmp_path, [case(1, "lpv-nmpc"), case(2)])
    show(browser, write_report(tmp_path), width)
    assert overflow(browser) == (0, [])
    tops = browser.execute_script(
        "return [...document.querySelectorAll('.plate.lone')].map((one) => one.offsetTop)"
    )
    assert (tops[0] == tops[1]) == (width > 700)


def test_its_policy_stops_what_is_not_its_own(browser, page):
    show(browser, page)
    browser.get_log("browser")
    browser.execute_script(
        "const one = document.createElement('img'); one.src = 'https://example.invalid/x.png';"
        "document.body.append(one);"
        "const two = document.createElement('script'); two.textContent = 'window.foreign = 1';"
        "document.body.append(two);"
    )
    told = " ".join(entry["message"] for entry in browser.get_log("browser"))
    assert told.count("Content Security Policy") == 2
    assert browser.execute_script("return window.foreign") is None


def column(browser, table, name):
    """Return the texts of a column and its heading."""
    heads = browser.find_elements(By.CSS_SELECTOR, f"#{table} thead th")
    place = next(k for k, head in enumerate(heads) if head.text.startswith(name))
    cells = browser.find_elements(By.CSS_SELECTOR, f"#{table} tbody tr > :nth-child({place + 1})")
    return [cell.text for cell in cells], heads[place]


def table_of(browser, caption):
    """Return the id of the table whose caption contains the words."""
    found = browser.find_elements(By.CSS_SELECTOR, "figure.tabular")
    return next(one.get_attribute("id") for one in found if caption in one.text)


def test_tables_sort_by_numbers_and_words_and_come_back(browser, page):
    show(browser, page)
    table = table_of(browser, "Tracking errors in the paper's terms, m2-minibus · variable speed.")
    before, head = column(browser, table, "ALE")
    agents, _ = column(browser, table, "agent")
    # Published and drawn-up values: as numbers, not as words.
    assert sorted(before) != before
    head.find_element(By.TAG_NAME, "button").send_keys(Keys.ENTER)
    assert head.get_attribute("aria-sort") == "ascending"
    values, _ = column(browser, table, "ALE")
    known = [float(text) for text in values if text != "–"]
    assert known == sorted(known)
    assert values[-1] == "–"
    head.find_element(By.TAG_NAME, "button").click()
    assert head.get_attribute("aria-sort") == "descending"
    values, _ = column(browser, table, "ALE")
    assert [float(text) for text in values if text != "–"] == known[::-1]
    assert values[-1] == "–"
    # Every line names its path, now that lines no longer stand in groups.
    assert all(column(browser, table, "path")[0])
    head.find_element(By.TAG_NAME, "button").click()
    assert head.get_attribute("aria-sort") is None
    assert column(browser, table, "ALE")[0] == before
    _, words = column(browser, table, "agent")
    words.find_element(By.TAG_NAME, "button").click()
    assert column(browser, table, "agent")[0] == sorted(agents, key=str.lower)


def test_equal_values_keep_their_order(browser, page):
    show(browser, page)
    table = table_of(browser, "Tracking errors in the paper's terms, m2-minibus · variable speed.")
    agents, _ = column(browser, table, "agent")
    ends, head = column(browser, table, "AOE")
    head.find_element(By.TAG_NAME, "button").click()
    after, _ = column(browser, table, "agent")
    same = [agent for agent, end in zip(agents, ends, strict=True) if end == "0.030"]
    assert [agent for agent in after if agent in same] == same


def test_colours_follow_the_system_and_the_button(browser, page):
    def background():
        return browser.execute_script("return getComputedStyle(document.body).backgroundColor")

    def line():
        return browser.execute_script(
            "return getComputedStyle(document.querySelector('figure .panel .l.c0')).stroke"
        )

    prefer(browser, prefers_color_scheme="light")
    show(browser, page)
    light, stroke = background(), line()
    prefer(browser, prefers_color_scheme="dark")
    dark = background()
    assert dark != light
    assert line() != stroke
    button = browser.find_element(By.ID, "colours")
    seen = {}
    for _ in range(3):
        button.click()
        seen[button.text] = background()
    assert seen == {"colours: light": light, "colours: dark": dark, "colours: auto": dark}
    prefer(browser, prefers_color_scheme="light")


@pytest.mark.parametrize("width", [PHONE, DESK])
def test_the_replay_is_scrubbed_by_slider_keys_and_charts(browser, page, width):
    show(browser, page, width)
    slider = browser.find_element(By.ID, "replay-time")
    clock = browser.find_element(By.ID, "replay-clock")
    # Both drives of the leading agent: 1240 and 1280 periods of 0.05 s.
    WebDriverWait(browser, 5).until(lambda _: clock.text == "0.0 of 64.0 s")
    before = [pixels(browser, f"#replay-{name}") for name in ("view", "lateral", "speed")]
    assert len(set(before)) == 3
    slider.send_keys(Keys.END)
    WebDriverWait(browser, 5).until(lambda _: clock.text == "64.0 of 64.0 s")
    after = [pixels(browser, f"#replay-{name}") for name in ("view", "lateral", "speed")]
    assert all(one != other for one, other in zip(before, after, strict=True))
    assert slider.get_attribute("aria-valuetext") == "64.0 of 64.0 s"
    slider.send_keys(Keys.ARROW_LEFT)
    WebDriverWait(browser, 5).until(lambda _: clock.text != "64.0 of 64.0 s")
    chart = browser.find_element(By.ID, "replay-heading")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", chart)
    chart.click()
    WebDriverWait(browser, 5).until(
        lambda _: clock.text.startswith(("31.8", "31.9", "32.0", "32.1", "32.2"))
    )
    assert "T1 from above at" in browser.find_element(By.ID, "replay-view").accessible_name


def test_the_replay_says_what_was_driven(browser, page):
    """Values of the embedded, quantised drive equal those of its trace."""
    show(browser, page)
    Select(browser.find_element(By.ID, "replay-second")).select_by_visible_text("none")
    slider = browser.find_element(By.ID, "replay-time")
    slider.send_keys(Keys.END)
    clock = browser.find_element(By.ID, "replay-clock")
    WebDriverWait(browser, 5).until(lambda _: clock.text == "62.0 of 62.0 s")
    cells = browser.find_elements(By.CSS_SELECTOR, ".readout tbody td")
    made = trace(n=1241, noise=0.01)
    shown = [float(cell.text.replace("−", "-")) for cell in cells[:6]]
    wanted = [
        made["lateral_error"][-1], made["heading_error"][-1], made["state"][-1, 2],
        made["state"][-1, 0], made["steering_angle"][-1], made["acceleration"][-1],
    ]  # fmt: skip
    np.testing.assert_allclose(shown, wanted, atol=6e-3)


def test_the_replay_plays_pauses_and_shows_other_drives(browser, page):
    show(browser, page)
    # Long enough at this rate that it does not end by itself on a slow machine.
    Select(browser.find_element(By.ID, "replay-rate")).select_by_visible_text("×1")
    play = browser.find_element(By.ID, "replay-play")
    clock = browser.find_element(By.ID, "replay-clock")
    play.click()
    WebDriverWait(browser, 5).until(lambda _: not clock.text.startswith("0.0"))
    assert play.get_attribute("aria-pressed") == "true"
    play.click()
    assert play.get_attribute("aria-pressed") == "false"
    paths = Select(browser.find_element(By.ID, "replay-path"))
    assert [option.text for option in paths.options][:2] == ["T1", "T2"]
    paths.select_by_visible_text("T2")
    first = Select(browser.find_element(By.ID, "replay-first"))
    assert first.first_selected_option.text == "lpv-nmpc, simulation, seed 0"
    second = Select(browser.find_element(By.ID, "replay-second"))
    assert second.first_selected_option.text == "lpv-nmpc, realtime, seed 0"
    far = pixels(browser, "#replay-view")
    browser.find_element(By.ID, "replay-follow").click()
    WebDriverWait(browser, 5).until(lambda _: pixels(browser, "#replay-view") != far)
    # A name that tries to break out of the data is a name.
    paths.select_by_visible_text("a-rather-long-name-of-a-path.csv")
    assert HOSTILE in first.first_selected_option.text


def test_the_replay_moves_in_steps_where_motion_is_not_wanted(browser, page):
    prefer(browser, prefers_reduced_motion="reduce")
    show(browser, page)
    browser.find_element(By.ID, "replay-play").click()
    times = browser.execute_async_script(
        "const done = arguments[0], seen = new Set(), began = performance.now();"
        "const look = () => { seen.add(document.getElementById('replay-clock').textContent);"
        "  if (performance.now() - began > 2200) done([...seen]); else requestAnimationFrame(look);"
        "}; look();"
    )
    assert 2 <= len(times) <= 6
    prefer(browser, prefers_reduced_motion="no-preference")


def test_the_printed_page_is_light_and_without_controls(browser, page):
    show(browser, page)
    prefer(browser, prefers_color_scheme="dark")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    style = "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]"
    assert browser.execute_script(style, "body", "backgroundColor") == "rgb(255, 255, 255)"
    for hidden in ("#colours", "#replay", "nav"):
        assert browser.execute_script(style, hidden, "display") == "none"
    assert browser.execute_script(style, "figure.plate", "breakInside") == "avoid"
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})

"""The pages in a real browser: they play, answer clicks and keys, and complain of nothing."""

import json
import re

import numpy as np
import pytest
from view_pages import HOSTILE, Reader, write_results

from navrep_data.view import Scene, dataset_page, results_page

pytestmark = pytest.mark.slow

ROW = "Number(document.querySelector('#slider').value)"
# A hash of a canvas's pixels and how many colours it has; read from a copy, so that the page's canvas stays as it is.
PRINT = """(id => {
  const c = document.getElementById(id), copy = document.createElement('canvas');
  Object.assign(copy, {width: c.width, height: c.height});
  const ctx = copy.getContext('2d', {willReadFrequently: true});
  ctx.drawImage(c, 0, 0);
  const d = ctx.getImageData(0, 0, c.width, c.height).data, seen = new Set();
  let h = 0;
  for (let i = 0; i < d.length; i += 4) {
    const v = (d[i] << 16) | (d[i + 1] << 8) | d[i + 2];
    h = (h * 31 + v) | 0;
    if (d[i + 3]) seen.add(v);
  }
  return [h, seen.size];
})"""
PANELS = ("world", "polar", "strip", "rings-canvas", "curves")


def show(browser, file, **options):
    tab = browser.open(file.as_uri(), **options)
    tab.wait("document.body.dataset.ready !== undefined || !document.querySelector('#fatal').hidden")
    assert tab.evaluate("document.querySelector('#fatal').textContent") == ""
    return tab


@pytest.fixture
def tab(browser, page_file):
    tab = show(browser, page_file)
    yield tab
    assert tab.problems() == []
    tab.close()


def test_it_plays_and_pauses(tab):
    before = {name: tab.evaluate(f"{PRINT}('{name}')") for name in PANELS}
    assert all(colours > 3 for _, colours in before.values())
    tab.click("#play")
    tab.wait(f"{ROW} > 3")
    assert tab.evaluate("document.querySelector('#play').getAttribute('aria-label')") == "Pause"
    tab.click("#play")
    row = tab.evaluate(ROW)
    after = {name: tab.evaluate(f"{PRINT}('{name}')") for name in PANELS}
    assert all(before[name] != after[name] for name in PANELS)
    tab.evaluate("new Promise(done => setTimeout(done, 400))")
    assert tab.evaluate(ROW) == row
    assert f"row {row} of 149" in tab.evaluate("document.querySelector('#clock').textContent")
    assert f"row {row} " in tab.evaluate("document.querySelector('#live').textContent")


def test_speed_is_rows_per_time(tab):
    tab.evaluate("(s => { s.value = '4'; s.dispatchEvent(new Event('change')); })(document.querySelector('#speed'))")
    # The test is the page's clock: a frame every 10 ms for two seconds and one frame, however long each takes to draw.
    rows = tab.evaluate(
        f"""(() => {{
          let frames = [];
          window.requestAnimationFrame = frame => frames.push(frame);
          performance.now = () => 1000;
          document.querySelector('#play').click();
          for (let now = 1010; now <= 3010; now += 10) {{
            const due = frames;
            frames = [];
            due.forEach(frame => frame(now));
          }}
          return {ROW};
        }})()"""
    )
    assert rows == 40  # 4 times real time, 5 rows a second, for two seconds


def test_a_click_on_an_episode_goes_there(tab, page_file):
    episodes = Reader(page_file.read_bytes()).meta["sequences"][0]["episodes"]
    assert len(episodes) > 2
    for k in (len(episodes) - 1, 1):
        tab.click(f"#timeline button:nth-child({k + 1})")
        assert tab.evaluate(ROW) == episodes[k]["start"]
        current = tab.evaluate("[...document.querySelectorAll('#timeline [aria-current]')].map(b => b.title)")
        assert len(current) == 1
        assert current[0].startswith(f"Episode {episodes[k]['episode']}: ")
    colours = {
        e["event"]: tab.evaluate(f"document.querySelectorAll('#timeline button')[{k}].style.background")
        for k, e in enumerate(episodes)
    }
    assert len(set(colours.values())) == len(colours) > 1


def test_keys(tab, page_file):
    starts = [e["start"] for e in Reader(page_file.read_bytes()).meta["sequences"][0]["episodes"]]
    for key, row in (
        ("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", 149), ("Home", 0), ("n", starts[1]),
        ("n", starts[2]), ("p", starts[1]), ("ArrowRight", starts[1] + 1),
    ):  # fmt: skip
        tab.press(key)
        assert tab.evaluate(ROW) == row, key
    tab.press(" ")
    tab.wait(f"{ROW} > {starts[1] + 3}")
    tab.press(" ")
    assert tab.evaluate("document.querySelector('#play').getAttribute('aria-label')") == "Play"
    tab.press("?")
    assert tab.evaluate("document.querySelector('#helpbox').open") is True
    row = tab.evaluate(ROW)
    tab.press("ArrowRight")  # of no effect behind the help
    assert tab.evaluate(ROW) == row
    tab.click("#help-close")
    assert tab.evaluate("document.querySelector('#helpbox').open") is False
    before = tab.evaluate(f"{PRINT}('world')")
    tab.press("f")
    assert tab.evaluate("document.querySelector('#follow').getAttribute('aria-pressed')") == "false"
    assert tab.evaluate(f"{PRINT}('world')") != before
    tab.press("d")
    assert tab.evaluate("document.documentElement.dataset.theme") == "dark"


def test_slider_curves_and_sequences(tab):
    tab.click("#slider", 0.5, 0.5)
    assert 60 < tab.evaluate(ROW) < 90
    tab.press("Home")
    tab.press("n")
    start = tab.evaluate(ROW)
    tab.click("#curves", 0.9, 0.5)
    length = tab.evaluate("Number(/step \\d+ of (\\d+)/.exec(document.querySelector('#clock').textContent)[1])")
    assert length > 5
    assert 0.7 * length < tab.evaluate(ROW) - start < length
    tab.evaluate("(s => { s.value = '2'; s.dispatchEvent(new Event('change')); })(document.querySelector('#sequence'))")
    tab.wait("document.body.dataset.ready === '2'")
    assert tab.evaluate(ROW) == 0


def test_what_is_shown_are_the_data(tab, page_file):
    page = Reader(page_file.read_bytes())
    entry = page.meta["sequences"][0]
    arrays = page.arrays(entry)
    row = entry["episodes"][1]["start"] + 5
    tab.evaluate(
        f"(s => {{ s.value = {row}; s.dispatchEvent(new Event('input')); }})(document.querySelector('#slider'))"
    )
    goal = np.hypot(*arrays["robot_state"][:2, row])
    people = int(np.isfinite(arrays["human_x"][:, row]).sum())
    seen = int(arrays["human_visible"][:, row].sum())
    speed = np.hypot(*arrays["robot_state"][2:4, row])
    shown = tab.evaluate("document.querySelector('#state').textContent")
    assert shown == f"goal {goal:.1f} m away · speed {speed:.2f} m/s · {people} people, {seen} seen"
    legend = tab.evaluate("document.querySelector('#curves-legend').textContent").replace("−", "-")
    numbers = [float(v) for v in re.findall(r"-?\d+\.\d+", legend)]
    np.testing.assert_allclose(numbers, [*arrays["action"][:, row], arrays["reward"][row]], atol=0.0051)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("phone", [False, True])
@pytest.mark.parametrize("kind", ["page_file", "results_file"])
def test_dark_and_light_desk_and_phone(browser, request, kind, dark, phone):
    size = {"width": 390, "height": 844, "phone": True} if phone else {}
    tab = show(browser, request.getfixturevalue(kind), dark=dark, **size)
    assert tab.evaluate("document.documentElement.dataset.theme") == ("dark" if dark else "light")
    background = tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", background)[:3])) < 200) == dark
    width, height = tab.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert width <= (390 if phone else 1280)
    assert phone or height <= 800
    # play can be reached without scrolling, and is large enough for a finger
    left, top, right, bottom = tab.evaluate(
        "(b => [b.left, b.top, b.right, b.bottom])(document.querySelector('#play').getBoundingClientRect())"
    )
    assert 0 <= left < right <= width
    assert 0 <= top < bottom <= (844 if phone else 800)
    assert min(right - left, bottom - top) >= (38 if phone else 28)
    small = tab.evaluate("[...document.querySelectorAll('canvas')].map(c => [c.clientWidth, c.clientHeight]).flat()")
    assert min(small) >= 60
    assert tab.problems() == []
    tab.close()


def test_every_control_has_a_name(browser, page_file, results_file):
    for file in (page_file, results_file):
        tab = show(browser, file)
        nodes = tab.call("Accessibility.getFullAXTree")["nodes"]
        controls = [n for n in nodes if n.get("role", {}).get("value") in ("button", "slider", "combobox", "image")]
        assert len(controls) > 15
        assert [n["role"] for n in controls if not n.get("name", {}).get("value")] == []
        tab.close()


def test_without_decompression_stream(browser, page_file):
    tab = show(browser, page_file, before="delete window.DecompressionStream")
    assert tab.evaluate("typeof DecompressionStream") == "undefined"
    with_it = show(browser, page_file)
    for one in (tab, with_it):
        one.press("End")
    for name in PANELS:
        assert tab.evaluate(f"{PRINT}('{name}')") == with_it.evaluate(f"{PRINT}('{name}')")
    assert tab.problems() == []
    tab.close()
    with_it.close()


@pytest.mark.parametrize("before", ["", "delete window.DecompressionStream"])
def test_damaged_data_are_told(browser, page_file, tmp_path, before):
    html = page_file.read_text()
    start = html.index('id="blob-0">') + len('id="blob-0">')
    end = html.index("<", start)
    broken = tmp_path / "broken.html"
    broken.write_text(html[: start + (end - start) // 8 * 4] + html[end:])
    tab = browser.open(broken.as_uri(), before=before)
    tab.wait("document.querySelector('#fatal').textContent !== ''")
    assert "damaged. Make the page again" in tab.evaluate("document.querySelector('#fatal').textContent")
    assert tab.evaluate("document.querySelector('#fatal').checkVisibility()") is True
    assert tab.problems() == []
    tab.close()


def test_an_import_shows_what_it_has(browser, tmp_path, dataset, imported):
    tab = show(browser, dataset_page(imported).write(tmp_path / "imported.html"))
    for name in PANELS:
        assert tab.evaluate(f"{PRINT}('{name}')")[1] > 3
    before = tab.evaluate(f"{PRINT}('strip')")
    tab.press("ArrowRight")
    assert tab.evaluate(f"{PRINT}('strip')") != before
    # its environment has a hostile name: shown as text, nothing else
    assert HOSTILE in tab.evaluate("document.querySelector('#facts').textContent")
    assert tab.evaluate("document.images.length") == 0
    assert tab.problems() == []
    tab.close()


def test_hostile_results_are_text(browser, tmp_path):
    file = write_results(tmp_path / "r", HOSTILE, suite=HOSTILE)
    value = json.loads(file.read_text())
    value["episodes"]["scenario"] = [HOSTILE] * 60
    file.write_text(json.dumps(value))
    tab = show(browser, results_page(file).write(tmp_path / "hostile.html"), before="window.alert = () => { throw 1; }")
    assert HOSTILE in tab.evaluate("document.querySelector('#scenarios').textContent")
    assert tab.evaluate("document.title").startswith(HOSTILE)
    assert tab.evaluate("document.images.length") == 0
    assert tab.problems() == []
    tab.close()


def test_results_scenarios_trajectories_and_time(browser, results, tmp_path):
    def scene(name):
        occupied = np.zeros((40, 40), bool)
        occupied[0] = True
        return Scene(occupied, (-10.0, 10.0, -10.0, 10.0), np.zeros(2), np.array([5.0, 5.0]), np.ones((3, 2)))

    file = results_page(results, scene=scene).write(tmp_path / "results.html")
    meta = Reader(file.read_bytes()).meta
    tab = show(browser, file)
    first = tab.evaluate(f"{PRINT}('map')")
    tab.click("#scenarios button:nth-child(2)")
    tab.wait("document.body.dataset.ready === '0/1'")
    assert tab.evaluate(f"{PRINT}('map')") != first
    columns = meta["policies"][0]["columns"]
    mine = [k for k, s in enumerate(columns["scenario"]) if s == 1]
    assert tab.evaluate("document.querySelectorAll('#timeline button').length") == len(mine)
    tab.click("#timeline button:nth-child(3)")
    assert tab.evaluate("document.querySelector('#badge').textContent").startswith(f"episode {mine[2]}: ")
    state = tab.evaluate("document.querySelector('#state').textContent")
    assert f"{columns['steps'][mine[2]]} steps" in state
    assert f"path length {columns['metrics']['path_length'][mine[2]]} m" in state
    tab.press("Escape")
    assert tab.evaluate("document.querySelector('#badge').hidden") is True
    tab.press("Home")
    tab.press(" ")
    tab.wait(f"{ROW} > 3")
    tab.press("n")
    tab.wait("document.body.dataset.ready === '0/2'")
    tab.click("#policies button:nth-child(2)")
    tab.wait("document.body.dataset.ready === '1/2'")
    before = tab.evaluate(f"{PRINT}('map')")
    tab.click("#filters button")
    assert tab.evaluate(f"{PRINT}('map')") != before
    assert tab.problems() == []
    tab.close()


def test_the_policy_stops_what_is_injected(browser, page_file):
    """Not a promise of ours alone: the browser refuses markup and code that are not the page's own."""
    tab = show(browser, page_file)
    assert (
        tab.evaluate(
            "(() => { try { document.body.innerHTML = '<b>x</b>'; return 'set'; } catch (e) { return e.name; } })()"
        )
        == "TypeError"
    )
    tab.evaluate(
        "document.body.append(Object.assign(document.createElement('img'), {src: 'http://127.0.0.1:9/x.png'}))"
    )
    tab.wait("true")
    tab.evaluate("new Promise(done => setTimeout(done, 100))")
    assert any("Content Security Policy" in p for p in tab.problems())
    tab.close()

"""The page in a real browser: what it does, that nothing of a file acts on it, and that everybody can use it."""

from __future__ import annotations

import base64
import contextlib
import datetime
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode
from zoneinfo import ZoneInfo

import gymnasium as gym
import httpx
import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from browsing import CHROMIUM, FILLED, FLAGS, ink, picture_of
from gymnasium import spaces
from pages import EVIL, browsing, carts, robot
from playwright.sync_api import Browser, Locator, Page, Playwright, Route, expect, sync_playwright
from served import served
from serving import PASSWORD, serving
from waiting import wait_for

from tupli_mcap import EpisodeData, EpisodeWriter, F, TupliAPIClient, TupliEnvWrapper, write_recording
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.schema.times import local_text
from tupli_mcap.server.settings import Settings

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: tools/setup-viewer web")
PATIENCE = 60_000.0  # ms for what happens at last


class Seen(NamedTuple):
    """What a page complained of, and which hosts it asked."""

    complaints: list[str]
    hosts: set[str]


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@contextlib.contextmanager
def launched(playwright: Playwright, *flags: str) -> Iterator[Browser]:
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *flags])
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def chromium(playwright: Playwright) -> Iterator[Browser]:
    """A browser without WebGL, which only Rerun needs: it would draw every page with it, which takes twice as long."""
    with launched(playwright, "--disable-gpu") as browser:
        yield browser


@contextlib.contextmanager
def opened(chromium: Browser, address: str, **options: Any) -> Iterator[tuple[Page, Seen]]:
    """A new page of a new visitor, which tells what goes wrong in it."""
    context = chromium.new_context(base_url=address, viewport={"width": 1280, "height": 900}, **options)
    page, seen = context.new_page(), Seen([], set())
    page.set_default_timeout(PATIENCE)
    page.on("console", lambda told: seen.complaints.append(told.text) if told.type == "error" else None)
    page.on("pageerror", lambda error: seen.complaints.append(str(error)))
    page.on("request", lambda asked: seen.hosts.add(asked.url.split("/")[2]) if "://" in asked.url else None)
    try:
        yield page, seen
    finally:
        context.close()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("lab")
    carts(root, seeds=2, episodes=6)
    robot(root / "<b>evil<b>.mcap", text=EVIL)
    with browsing(root) as address:
        yield address


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(Settings(tmp_path_factory.mktemp("kept"))) as url:
        yield url


def places(address: str) -> list[str]:
    """A page of each kind."""
    told = httpx.get(f"{address}/episodes?format=json").json()["episodes"]
    uris = {episode["run"]["name"][:3]: episode["id"] for episode in told}  # of the carts, and of the robot
    of_carts = [episode["id"] for episode in told if episode["run"]["name"].startswith("ppo")]
    return [
        "/",
        "/?q=nothing",
        "/episodes?sort=-return",
        "/episodes?filter=steps+%3E",
        "/dataset/CartPole-v1",
        "/dataset/-",
        *(f"/episode/{uri}" for uri in uris.values()),
        f"/compare?episode={of_carts[0]}&episode={of_carts[-1]}",
        "/episode/nope",
    ]


def sign_in(page: Page, name: str = "admin", password: str = PASSWORD) -> None:
    page.goto("/sign-in")
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("heading", name="Datasets")).to_be_visible()


def upload_field(page: Page) -> Locator:
    """Signs in, and opens the page of uploads; where files are dropped."""
    sign_in(page)
    page.goto("/upload")
    return page.get_by_label("Drop recordings here", exact=False)


def violations(page: Page, *rules: str) -> list[str]:
    """What stands in the way of some; by these rules only, if any are given."""
    options = {"runOnly": {"type": "rule", "values": rules}} if rules else None
    found = Axe().run(page, options=options).response["violations"]
    return [f"{each['id']}: {node['html'][:120]}" for each in found for node in each["nodes"]]


class TestEverybody:
    @pytest.mark.parametrize("scheme", ["light", "dark"])
    def test_nothing_stands_in_the_way(self, chromium: Browser, lab: str, scheme: Any) -> None:
        of_colours = ("color-contrast", "link-in-text-block")
        rules = of_colours if scheme == "dark" else ()  # in the dark, colours differ and nothing else
        with opened(chromium, lab, color_scheme=scheme) as (page, _):
            for place in places(lab):
                page.goto(place)
                assert violations(page, *rules) == [], place

    def test_pages_of_servers(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, _):
            page.goto("/")
            assert violations(page) == []
            sign_in(page)
            for place in ("/", "/upload", "/groups", "/group?name=global", "/users", "/account"):
                page.goto(place)
                assert violations(page) == [], place

    def test_colours_of_the_system_leave_those_of_lines(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab, forced_colors="active") as (page, _):
            page.goto(places(lab)[-2])
            for i in range(2):
                key = picture_of(page.locator("thead .key").nth(i))[:, :16]
                assert (key.max(axis=2) - key.min(axis=2)).max() > 60
            page.goto("/dataset/CartPole-v1")
            current = page.get_by_role("link", name="Newest")
            assert current.evaluate("link => getComputedStyle(link).outlineStyle") == "solid"

    def test_a_screen_reader_hears_the_step_and_not_all_its_values(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episode/{told[0]['id']}")
            page.get_by_label("Step", exact=True).fill("4")
            nodes = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
            spoken = [
                node["name"]["value"]
                for node in nodes
                for each in node.get("properties", [])
                if each["name"] == "live" and each["value"]["value"] != "off"
            ]
            assert spoken == []
            said = page.get_by_label("Step", exact=True).get_attribute("aria-valuetext")
            assert said == "step 4 of 20"

    def test_a_phone(self, chromium: Browser, lab: str, server: str) -> None:
        for address, shown in ((lab, places(lab)), (server, ["/upload", "/groups", "/users", "/account"])):
            with opened(chromium, address) as (page, _):
                page.set_viewport_size({"width": 320, "height": 740})
                if address == server:
                    sign_in(page)
                for place in shown:
                    page.goto(place)
                    wide = page.evaluate("document.documentElement.scrollWidth")
                    assert wide <= 320, place

    def test_a_phone_shows_all_of_each_user(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, _):
            page.set_viewport_size({"width": 390, "height": 740})
            sign_in(page)
            page.goto("/users")
            shown = page.get_by_text("administrator")
            assert shown.evaluate("it => [it, it.parentNode].every(e => e.scrollWidth <= e.clientWidth)")
            table = page.get_by_role("region", name="Users")
            assert table.evaluate("shown => shown.scrollWidth <= shown.clientWidth")

    def test_rows_with_a_button_are_on_one_line(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, _):
            sign_in(page)
            page.goto("/groups")
            page.get_by_label("Name").fill("aligned")
            page.get_by_role("button", name="Create the group").click()
            name, roles, button = page.locator("table.pairs tr > *").all()
            foot = """it => { const text = document.createRange(); text.selectNodeContents(it);
                return text.getBoundingClientRect().bottom; }"""
            feet = [each.evaluate(foot) for each in (name, roles, button.locator("button"))]
            assert max(feet) - min(feet) <= 1

    def test_a_description_keeps_its_lines(self, chromium: Browser, tmp_path: Path) -> None:
        with TupliEnvWrapper(gym.make("CartPole-v1"), storage=tmp_path) as env:
            env.store(name="cart", description="one\n\ntwo")
            env.reset(seed=1)
            env.step(0)
        with browsing(tmp_path) as address, opened(chromium, address) as (page, _):
            page.goto("/")
            page.get_by_role("link", name="cart").click()
            assert page.locator(".lead").inner_text() == "one\n\ntwo"

    def test_a_phone_shows_a_long_episode(self, chromium: Browser, tmp_path: Path) -> None:
        steps = 200_000
        states, last = np.zeros((steps, 1), np.float32), np.arange(steps) == steps - 1
        episode = EpisodeData(states, np.zeros(steps, int), np.ones(steps), last, ~last & last, states[0])
        one, two = spaces.Box(-1, 1, (1,)), spaces.Discrete(2)
        write_recording(tmp_path / "long.mcap", [episode], observation_space=one, action_space=two)
        with browsing(tmp_path) as address, opened(chromium, address) as (page, _):
            page.set_viewport_size({"width": 320, "height": 740})
            page.goto("/dataset/-")
            expect(page.locator(".transport output")).to_contain_text("of 200000")
            assert page.evaluate("document.documentElement.scrollWidth") <= 320

    def test_a_phone_shows_a_long_name(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, _):
            page.set_viewport_size({"width": 320, "height": 740})
            sign_in(page)
            page.goto("/account")
            page.locator("input[name=name]").fill("x" * 100)
            page.get_by_role("button", name="Create a token").click()
            expect(page.get_by_role("status")).to_contain_text("Copy it now")
            assert page.evaluate("document.documentElement.scrollWidth") <= 320

    def test_a_long_name_leaves_room(self, chromium: Browser, tmp_path: Path) -> None:
        robot(tmp_path / "long.mcap", text="x" * 400, images=False)
        with browsing(tmp_path) as address, opened(chromium, address) as (page, _):
            page.goto("/dataset/-")
            table = page.get_by_role("region", name="Table of recordings")
            assert table.evaluate("table => table.scrollWidth <= table.clientWidth")
            page.set_viewport_size({"width": 320, "height": 740})
            page.locator(".stage h2 a").click()
            box = page.get_by_role("heading", level=1).bounding_box()
            assert box is not None and box["height"] < 80

    def test_a_phone_shows_returns(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab) as (page, _):
            page.set_viewport_size({"width": 360, "height": 740})
            page.goto("/episodes?sort=-return")
            shown = page.locator("tbody tr").first.locator("td.num").nth(1).bounding_box()
            assert shown is not None and shown["x"] + shown["width"] <= 360

    def test_times_are_in_the_zone_of_the_browser(self, chromium: Browser, lab: str) -> None:
        last = httpx.get(f"{lab}/dataset/CartPole-v1?format=json").json()["last_ns"]
        for zone in ("Asia/Kolkata", "America/St_Johns", "UTC"):
            there = datetime.datetime.fromtimestamp(last // 10**9, ZoneInfo(zone))
            with opened(chromium, lab, timezone_id=zone) as (page, seen):
                page.goto("/dataset/CartPole-v1")
                shown = page.locator("time").all_inner_texts()
                assert shown.count(str(there)) >= 3  # the facts, the table, the end of a chart
                assert {text[-6:] for text in shown} == {str(there)[-6:]} and not seen.complaints

    def test_without_scripts(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab, java_script_enabled=False) as (page, _):
            page.goto("/episodes?dataset=CartPole-v1&sort=-return")
            boxes = page.locator("input[name=episode]")
            for i in range(2):
                boxes.nth(i).check()
            page.get_by_role("button", name="Compare").click()
            expect(page.get_by_role("heading", name="2 episodes compared")).to_be_visible()
            page.goto("/dataset/CartPole-v1")
            last = httpx.get(f"{lab}/dataset/CartPole-v1?format=json").json()["last_ns"]
            expect(page.locator(".facts time")).to_have_text(local_text(last))  # as in tables of commands
            page.locator(".stage h2 a").click()
            page.locator("input[type=range]").fill("3")
            page.get_by_role("button", name="Show").click()
            expect(page.locator(".transport output")).to_contain_text("step 3 of")
            page.goto("/episodes?sort=-return")
            page.locator("tbody th a").first.click()
            following = page.get_by_role("link", name="Next").get_attribute("href")
            page.locator("input[type=range]").fill("2")
            page.get_by_role("button", name="Show").click()
            expect(page.locator(".transport output")).to_contain_text("step 2 of")
            expect(page.get_by_role("link", name="Next")).to_have_attribute("href", str(following))
            page.goto("/dataset/CartPole-v1")
            expect(page.get_by_role("button", name="Show")).to_have_count(0)  # of a page that has no step


class TestNothingActs:
    def test_texts_of_files(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab) as (page, seen):
            dialogs: list[str] = []
            page.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
            for place in places(lab):
                page.goto(place)
                page.wait_for_load_state("networkidle")
                assert "pwned" not in page.title().replace(EVIL, ""), place
                assert page.evaluate("document.querySelectorAll('main script, main img[src=x]').length") == 0
            assert dialogs == []
            assert {host.split(":")[0] for host in seen.hosts} == {"127.0.0.1"}
            statuses = ("status of 404", "status of 400")
            assert [told for told in seen.complaints if not any(status in told for status in statuses)] == []

    def test_no_page_of_another_host_frames_it(self, chromium: Browser, lab: str, tmp_path: Path) -> None:
        outer = tmp_path / "outer.html"
        outer.write_text(f'<iframe src="{lab}/" width="600" height="400"></iframe>')
        with opened(chromium, lab) as (page, seen):
            page.goto(outer.as_uri())
            page.wait_for_timeout(500)
            assert any("frame-ancestors" in told for told in seen.complaints)


def assert_replayed(page: Page, address: str, link: str) -> None:
    """Waits until the viewer within the page has drawn curves."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    page.goto(address)
    page.get_by_role("link", name=link).click()
    viewer = page.frame_locator("iframe")
    expect(viewer.locator("canvas")).to_be_visible(timeout=PATIENCE)
    expect(viewer.locator(".coming")).to_have_count(0, timeout=180_000)
    wait_for(lambda: ink(picture_of(viewer.locator("canvas"))) > FILLED)


class TestPlayer:
    def test_it_moves_pictures_lines_and_values(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, seen):
            page.goto(f"/episode/{told[0]['id']}")
            slider, picture = page.get_by_label("Step", exact=True), page.locator(".films img")
            value = page.locator("output[data-name='state.joints[0]']")
            expect(value).to_have_text("0")
            slider.focus()
            for _ in range(4):
                page.keyboard.press("ArrowRight")
            expect(page.locator(".transport output")).to_have_text("step 4 of 20")
            expect(picture).to_have_attribute(
                "src", f"/episode/{told[0]['id']}/picture/0/4", timeout=PATIENCE
            )
            expect(value).to_have_text("0.2")
            line = page.locator(".cursor line")
            assert float(line.get_attribute("x1").rstrip("%")) == pytest.approx(100 * 4 / 19)
            box = page.locator(".row .plot").first.bounding_box()
            page.mouse.click(box["x"] + box["width"], box["y"] + 5)
            expect(page.locator(".transport output")).to_have_text("step 19 of 20")
            expect(value).to_have_text("0.95")
            page.get_by_role("button", name="Play").click()
            expect(page.locator(".transport output")).to_have_text("step 19 of 20", timeout=PATIENCE)
            expect(page.get_by_role("button", name="Play")).to_be_visible()
            assert seen.complaints == []

    def test_negative_values_have_the_minus_sign_of_numbers(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=CartPole-v1").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episode/{told[0]['id']}")
            values = page.locator(".row output[data-name]")
            for _ in range(2):  # as the page came, and as its script changed it
                assert re.search("^\N{MINUS SIGN}[0-9.e]", "\n".join(values.all_inner_texts()), re.MULTILINE)
                assert not [text for text in values.all_inner_texts() if text.startswith("-")]
                page.get_by_label("Step", exact=True).focus()
                with page.expect_response("**/step/*"):
                    page.keyboard.press("ArrowRight")
                page.wait_for_timeout(100)

    def test_only_numbers_have_the_minus_sign(self, chromium: Browser, tmp_path: Path) -> None:
        parts = {"x": spaces.Box(-1, 1, (1,), np.float32), "said": spaces.Text(20)}
        with EpisodeWriter(tmp_path / "a.mcap", spaces.Dict(parts), spaces.Discrete(2)) as writer:
            writer.begin()
            for _ in range(3):
                writer.step({"x": np.array([-1e-5], np.float32), "said": "-5 apples"}, 0, reward=-1.5)
        with browsing(tmp_path) as address, opened(chromium, address) as (page, _):
            told = httpx.get(f"{address}/episodes?format=json").json()["episodes"]
            page.goto(f"/episode/{told[0]['id']}")
            for _ in range(2):  # as the page came, and as its script changed it
                texts = page.locator("output[data-name]").all_inner_texts()
                assert {"-5 apples", "\N{MINUS SIGN}1e\N{MINUS SIGN}05"} <= set(texts)
                page.get_by_label("Step", exact=True).focus()
                with page.expect_response("**/step/*"):
                    page.keyboard.press("ArrowRight")
                page.wait_for_timeout(100)

    def test_the_names_of_actions_are_whole(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=CartPole-v1").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            for place in (
                f"/episode/{told[0]['id']}",
                f"/compare?episode={told[0]['id']}&episode={told[1]['id']}",
            ):
                page.goto(place)
                action = page.locator("output[data-name='action']").first
                expect(action).to_contain_text(re.compile("Push cart to the (left|right)"))
                assert action.evaluate("shown => shown.scrollHeight <= shown.clientHeight")
                assert action.evaluate("shown => shown.scrollWidth <= shown.clientWidth")

    def test_compared_values(self, chromium: Browser, lab: str) -> None:
        asked = f"{lab}/episodes?format=json&dataset=CartPole-v1&sort=steps"
        told = httpx.get(asked).json()["episodes"]
        short, long = min(told[:3], key=lambda e: e["id"]), told[-1]
        with opened(chromium, lab) as (page, seen):
            page.goto(f"/compare?episode={long['id']}&episode={short['id']}")
            names = page.locator("thead .key").all_inner_texts()
            place = (
                0 if short["run"]["name"] in names[0] and names[0].startswith(str(short["episode"])) else 1
            )
            shown = page.locator("output[data-name='return so far']")
            expect(shown.nth(0)).to_have_text("1")
            for step in (short["n_tuples"] - 1, short["n_tuples"]):
                page.get_by_label("Step", exact=True).fill(str(step))
                expect(shown.nth(1 - place)).to_have_text(str(step + 1))
                expect(shown.nth(place)).to_have_text(str(step + 1) if step < short["n_tuples"] else "")
            assert seen.complaints == []

    def test_compared_numbers_are_not_broken(self, chromium: Browser, tmp_path: Path) -> None:
        episodes = [EpisodeData([0], [0], [value], [True], [False]) for value in (-1.2345e-5, -0.0027183)]
        path, space = tmp_path / "r.mcap", spaces.Discrete(2)
        write_recording(path, episodes, observation_space=space, action_space=space)
        with browsing(path) as address, opened(chromium, address) as (page, _):
            told = httpx.get(f"{address}/episodes?format=json").json()["episodes"]
            page.goto("/compare?" + "&".join(f"episode={each['id']}" for each in told))
            for place in range(2):
                shown = page.locator("output[data-name='reward']").nth(place)
                expect(shown).to_have_text(re.compile(r"\d{5}|e.05"))
                assert shown.evaluate(
                    "it => it.clientHeight < 1.5 * parseFloat(getComputedStyle(it).lineHeight)"
                )

    def test_values_of_episodes_that_have_ended_keep_their_places(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=CartPole-v1&sort=steps").json()["episodes"]
        chosen = [*told[:7], told[-1]]
        with opened(chromium, lab) as (page, _):
            page.goto("/compare?" + "&".join(f"episode={each['id']}" for each in chosen))
            rows, values = page.locator(".each"), page.locator("output[data-name='return so far']")
            before = rows.first.evaluate("row => row.clientHeight")
            page.get_by_label("Step", exact=True).fill(str(chosen[-1]["n_tuples"] - 1))
            expect(values.filter(has_text=re.compile("."))).to_have_count(1)
            assert rows.first.evaluate("row => row.clientHeight") == before

    def test_a_picture_that_cannot_be_read(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.route("**/picture/0/4", lambda route: route.fulfill(status=500))
            page.goto(f"/episode/{told[0]['id']}?step=4")
            picture = page.locator(".films img")
            expect(picture).to_have_attribute("alt", re.compile("it cannot be read$"))
            page.get_by_label("Step", exact=True).fill("5")
            expect(picture).to_have_attribute("alt", re.compile("at this step$"))
            page.goto(f"/compare?episode={told[0]['id']}&episode={told[1]['id']}")
            expect(page.locator(".films img").first).to_have_class("pixels")

    def test_going_back_to_a_step(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episode/{told[0]['id']}")
            page.get_by_label("Step", exact=True).fill("4")
            page.goto("/")
            page.go_back()
            expect(page.get_by_label("Step", exact=True)).to_have_value("4")
            expect(page.locator(".transport output")).to_have_text("step 4 of 20")
            expect(page.locator("output[data-name='state.joints[0]']")).to_have_text("0.2")

    def test_dragging_over_a_curve(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episode/{told[0]['id']}")
            box = page.locator(".row .plot").first.bounding_box()
            page.mouse.move(box["x"], box["y"] + 5)
            page.mouse.down()
            for step in (5, 10):
                page.mouse.move(box["x"] + box["width"] * step / 19, box["y"] + 5)
                expect(page.locator(".transport output")).to_have_text(f"step {step} of 20")
            page.mouse.up()
            page.mouse.move(box["x"], box["y"] + 5)
            expect(page.locator(".transport output")).to_have_text("step 10 of 20")
            expect(page).to_have_url(re.compile(r"\?step=10$"))
            page.mouse.down()
            page.mouse.move(box["x"] + box["width"] + 50, box["y"] - 200)
            page.mouse.up()
            expect(page.locator(".transport output")).to_have_text("step 19 of 20")
            expect(page).to_have_url(re.compile(r"\?step=19$"))
            page.get_by_role("heading", level=1).hover()
            page.mouse.down()
            page.mouse.move(box["x"] + 50, box["y"] + 5, steps=5)
            page.mouse.up()
            expect(page.locator(".transport output")).to_have_text("step 19 of 20")

    def test_the_address_keeps_the_step(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episode/{told[0]['id']}?sort=-return")
            page.get_by_label("Step", exact=True).fill("4")
            expect(page).to_have_url(re.compile(r"\?sort=-return&step=4$"))
            page.reload()
            expect(page.locator(".transport output")).to_have_text("step 4 of 20")
            box = page.locator(".row .plot").first.bounding_box()
            page.mouse.click(box["x"] + box["width"], box["y"] + 5)
            expect(page).to_have_url(re.compile("&step=19$"))
            page.get_by_role("button", name="Play").click()
            page.get_by_role("button", name="Pause").click()
            stopped = re.search(r"step (\d+)", page.locator(".transport output").inner_text())
            assert stopped is not None
            expect(page).to_have_url(re.compile(f"&step={stopped[1]}$"))
            page.goto("/dataset/-")
            page.get_by_label("Step", exact=True).fill("4")
            page.wait_for_timeout(500)
            assert page.url.endswith(
                "/dataset/-"
            )  # shows one of its episodes, and the next time perhaps another
            page.goto(f"/episode/{told[0]['id']}")
            written = page.evaluate(
                """() => {
                    let count = 0;
                    const replace = history.replaceState.bind(history);
                    history.replaceState = (...told) => (count++, replace(...told));
                    const slider = document.querySelector("input[type=range]");
                    for (let step = 0; step < 10; step++) {
                        slider.value = step;
                        slider.dispatchEvent(new Event("change"));
                    }
                    return new Promise((told) => setTimeout(() => told(count), 1000));
                }"""
            )
            assert written == 1  # however fast the steps come: browsers refuse too many changes
            expect(page).to_have_url(re.compile(r"\?step=9$"))

    def test_seeking_while_it_plays(self, chromium: Browser, lab: str) -> None:
        told = httpx.get(f"{lab}/episodes?format=json&dataset=-").json()["episodes"]
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episode/{told[0]['id']}?step=10")
            page.get_by_role("button", name="Play").click()
            box = page.locator(".row .plot").first.bounding_box()
            page.mouse.click(box["x"], box["y"] + 5)
            expect(page.get_by_role("button", name="Play")).to_be_visible()
            page.wait_for_timeout(300)
            expect(page.locator(".transport output")).to_have_text("step 0 of 20")

    def test_it_shows_nothing_of_another_step(self, chromium: Browser, server: str, tmp_path: Path) -> None:
        robot(tmp_path / "robot.mcap", episodes=1)
        with TupliAPIClient(server) as client:
            client.login("admin", PASSWORD)
            client.push(tmp_path / "robot.mcap")
            (header,) = client.list_episodes(F("steps") == 20)
        with opened(chromium, server) as (page, _):
            sign_in(page)
            page.goto(f"/episode/{header.id}?step=4")
            slider, value = (
                page.get_by_label("Step", exact=True),
                page.locator("[data-name='state.joints[0]']"),
            )
            expect(value).to_have_text("0.2")
            cookies = page.context.cookies()
            page.context.clear_cookies()
            slider.fill("8")
            expect(value).to_have_text("")
            expect(page.locator(".films img")).to_have_attribute("src", re.compile(r"/picture/0/8$"))
            page.context.add_cookies(cookies)
            slider.fill("10")
            expect(value).to_have_text("0.5")

    @pytest.mark.sampled(0)  # the page is the same for a user who is signed in
    def test_rerun_is_shown_within_the_page(self, playwright: Playwright, lab: str) -> None:
        uri = httpx.get(f"{lab}/episodes?format=json&dataset=CartPole-v1").json()["episodes"][0]["id"]
        with launched(playwright, *FLAGS) as browser, opened(browser, lab) as (page, seen):
            assert_replayed(page, f"/episode/{uri}", "Replay in Rerun")
            assert {host.split(":")[0] for host in seen.hosts} == {"127.0.0.1"}

    def test_rerun_shows_what_only_a_signed_in_user_may_see(
        self, playwright: Playwright, server: str, tmp_path: Path
    ) -> None:
        carts(tmp_path, seeds=1, episodes=2)
        with TupliAPIClient(server) as client:
            client.login("admin", PASSWORD)
            client.push(tmp_path / "ppo0.mcap")
            header = client.list_episodes(F("run.name") == "ppo-seed0")[0]
        with launched(playwright, *FLAGS) as browser, opened(browser, server) as (page, seen):
            sign_in(page)
            assert_replayed(page, f"/episode/{header.id}", "Replay in Rerun")
            assert {host.split(":")[0] for host in seen.hosts} == {"127.0.0.1"}
            page.reload()
            page.context.clear_cookies()
            page.get_by_role("link", name="Replay in Rerun").click()
            expect(page.get_by_role("heading", name="Sign in")).to_be_visible()


class TestTable:
    def test_choosing_by_keyboard(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab) as (page, _):
            page.goto("/episodes?dataset=CartPole-v1&sort=-return")
            compare = page.get_by_role("button", name="Compare")
            expect(compare).to_be_disabled()
            page.get_by_label("Select episode", exact=False).first.focus()
            page.keyboard.press("Space")
            expect(page.locator("[data-count]")).to_have_text("1 selected")
            expect(compare).to_be_disabled()
            page.get_by_label("Select episode", exact=False).nth(1).focus()
            page.keyboard.press("Space")
            expect(compare).to_be_enabled()
            compare.focus()
            page.keyboard.press("Enter")
            expect(page.get_by_role("heading", name="2 episodes compared")).to_be_visible()

    def test_choosing_from_several_tables(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab) as (page, seen):
            page.goto("/episodes?filter=run.name+%3D+'ppo-seed0'")
            count = page.locator("[data-count]")
            expect(page.get_by_role("button", name="Select none")).to_be_hidden()
            page.get_by_label("Select episode", exact=False).first.check()
            page.get_by_role("link", name="Return").click()
            expect(count).to_have_text("1 selected")
            for wanted in ("steps >", "steps > 1e9", "run.name = 'ppo-seed1'"):
                page.get_by_label("Filter").fill(wanted)
                page.get_by_role("button", name="Apply").click()
            expect(count).to_have_text("1 selected, 1 of them not on this page")
            page.get_by_label("Select episode", exact=False).first.check()
            expect(count).to_have_text("2 selected, 1 of them not on this page")
            page.get_by_role("button", name="Compare").click()
            expect(page.get_by_role("heading", name="2 episodes compared")).to_be_visible()
            runs = page.locator("thead .key").all_inner_texts()
            assert ["seed0" in run for run in runs] == [True, False]
            page.go_back()
            expect(count).to_have_text("2 selected, 1 of them not on this page")
            page.reload()
            expect(count).to_have_text("2 selected, 1 of them not on this page")
            page.get_by_role("button", name="Select none").click()
            expect(count).to_have_text("Select episodes to compare or download them")
            assert "episode=" not in page.url
            page.get_by_role("link", name="Clear").click()
            expect(page.locator("tbody input:checked")).to_have_count(0)
            assert [told for told in seen.complaints if "status of 400" not in told] == []

    def test_a_selection_in_an_address_becomes_no_other_code(self, chromium: Browser, lab: str) -> None:
        gone = "0" * 32 + "-1"
        code = 'x"]\') + print("pwned") #'
        with opened(chromium, lab) as (page, _):
            page.goto(f"/episodes?{urlencode({'episode': [code, gone]}, doseq=True)}")
            expect(page.locator("[data-count]")).to_have_text("1 selected, 1 of them not on this page")
            copied = page.get_by_role("button", name="Copy Python", exact=True).get_attribute("data-copy")
            assert copied is not None and copied.endswith(f".filter('id in [\"{gone}\"]')")
            expect(page).to_have_url(re.compile(f"/episodes\\?episode={gone}$"))

    def test_how_many_can_be_downloaded_is_said_before(self, chromium: Browser, lab: str) -> None:
        download = "Download", "at most 8 can be compared, and 1,000 downloaded: filter, and download all"
        with opened(chromium, lab) as (page, _):
            for count, enabled in ((1000, True), (1001, False)):
                ids = [f"{'0' * 32}-{i}" for i in range(count)]
                page.goto(f"/episodes?{urlencode({'episode': ids}, doseq=True)}")
                button = page.get_by_role("button", name=download[0], exact=True)
                expect(button).to_be_enabled() if enabled else expect(button).to_be_disabled()
                assert (download[1] in page.locator("[data-count]").inner_text()) != enabled

    def test_all_of_a_page(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab, permissions=["clipboard-read", "clipboard-write"]) as (page, _):
            page.goto("/episodes?dataset=CartPole-v1")
            page.get_by_label("Select all episodes of this page").check()
            expect(page.locator("[data-count]")).to_have_text("12 selected; at most 8 can be compared")
            expect(page.get_by_role("button", name="Compare")).to_be_disabled()
            page.get_by_role("button", name="Copy Python", exact=True).click()
            expect(page.get_by_role("button", name="Copied")).to_be_visible()
            copied = page.evaluate("navigator.clipboard.readText()")
            assert copied.startswith("tupli_mcap.open(") and copied.count('", "') == 11
            expect(page.locator("td.spark path")).to_have_count(12)
            with page.expect_download() as download:
                page.get_by_role("button", name="Download", exact=True).click()
            assert download.value.suggested_filename == "CartPole-v1-12-episodes.mcap"

    def test_a_download_after_the_sign_in_has_ended(
        self, chromium: Browser, server: str, tmp_path: Path
    ) -> None:
        carts(tmp_path, seeds=1, episodes=1)
        with TupliAPIClient(server) as client:
            client.login("admin", PASSWORD)
            client.push(tmp_path / "ppo0.mcap")
        with opened(chromium, server) as (page, _):
            sign_in(page)
            page.goto("/episodes?filter=run.name+%3D+'ppo-seed0'")
            page.context.clear_cookies()
            page.get_by_role("link", name="Download all").click()
            expect(page.get_by_role("heading", name="Sign in")).to_be_visible()

    def test_skipping_to_the_content(self, chromium: Browser, lab: str) -> None:
        with opened(chromium, lab) as (page, _):
            page.goto("/")
            page.keyboard.press("Tab")
            expect(page.get_by_role("link", name="Skip to the content")).to_be_focused()


class TestForms:
    def test_a_double_click_sends_a_form_once(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, seen):
            sign_in(page)
            page.goto("/groups")
            page.get_by_label("Name").fill("clicked-twice")
            button = page.get_by_role("button", name="Create the group")
            page.route("**/groups", lambda route: (page.mouse.down(), page.mouse.up(), route.continue_()))
            button.click(no_wait_after=True)
            expect(page.get_by_role("heading", name="clicked-twice")).to_be_visible()
            assert seen.complaints == []

    def test_a_form_whose_sending_was_stopped_can_be_sent_again(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, _):
            sign_in(page)
            page.goto("/groups")
            page.get_by_label("Name").fill("stopped")
            button = page.get_by_role("button", name="Create the group")
            held: list[Route] = []
            page.route("**/groups", lambda route: held.append(route), times=1)
            button.click(no_wait_after=True)
            page.wait_for_timeout(100)
            page.keyboard.press("Escape")
            page.context.new_cdp_session(page).send(
                "Page.stopLoading"
            )  # what a browser with a window does then
            assert len(held) == 1
            button.click(no_wait_after=True)
            expect(page.get_by_role("heading", name="stopped")).to_be_visible()

    def test_to_reload_the_answer_sends_no_form_again(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, seen):
            sign_in(page)
            page.goto("/account")
            page.get_by_label("Name", exact=True).fill("reloaded")
            page.get_by_role("button", name="Create a token").click()
            expect(page.get_by_role("status")).to_contain_text("Copy it now")
            page.reload()
            expect(page.get_by_role("rowheader", name="reloaded")).to_have_count(1)
            assert page.url == f"{server}/account" and seen.complaints == []
            page.goto("/group?name=global")
            page.get_by_role("textbox", name="User").fill("nobody")
            page.get_by_role("button", name="Add").click()
            expect(page.get_by_role("alert")).to_be_visible()
            page.reload()
            expect(page.get_by_role("button", name="Add")).to_be_visible()
            expect(page.get_by_role("alert")).to_have_count(0)

    def test_to_reload_an_error_sends_no_form_again(self, chromium: Browser, server: str) -> None:
        with opened(chromium, server) as (page, _):
            page.goto("/sign-in?next=/groups")
            page.get_by_label("Name").fill("admin")
            page.get_by_label("Password").fill("wrong")
            page.get_by_role("button", name="Sign in").click()
            expect(page.get_by_role("alert")).to_be_visible()
            page.reload()
            expect(page.get_by_role("alert")).to_have_count(0)
            page.get_by_label("Name").fill("admin")
            page.get_by_label("Password").fill(PASSWORD)
            page.get_by_role("button", name="Sign in").click()
            expect(page.get_by_role("heading", name="Groups")).to_be_visible()
            page.locator("form[action='/groups'] input[name=code]").evaluate("field => (field.value = '')")
            page.get_by_label("Name").fill("never")
            page.get_by_role("button", name="Create the group").click()
            expect(page.get_by_role("heading", name="Not allowed")).to_be_visible()
            page.reload()
            expect(page.get_by_role("heading", name="Groups")).to_be_visible()

    def test_after_a_sign_in_that_has_ended_comes_the_page_of_the_form(
        self, chromium: Browser, server: str
    ) -> None:
        with opened(chromium, server) as (page, _):
            sign_in(page)
            page.goto("/group?name=global")
            page.context.clear_cookies()
            page.get_by_role("textbox", name="User").fill("nobody")
            page.get_by_role("button", name="Add").click()
            page.get_by_role("main").get_by_role("link", name="Sign in").click()
            page.get_by_label("Name").fill("admin")
            page.get_by_label("Password").fill(PASSWORD)
            page.get_by_role("button", name="Sign in").click()
            expect(page.get_by_role("heading", name="global")).to_be_visible()


class TestUpload:
    def test_dropped_files(self, chromium: Browser, server: str, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=2)
        (tmp_path / "no recording.mcap").write_bytes(b"<script>1</script>")
        with opened(chromium, server) as (page, seen):
            sign_in(page)
            page.get_by_role("link", name="Upload", exact=True).click()
            field = page.get_by_label("Drop recordings here", exact=False)
            for _ in range(2):
                field.set_input_files(tmp_path / "ppo0.mcap")
            rows = page.locator(".uploads li")
            expect(rows.nth(0)).to_contain_text("is here", timeout=PATIENCE)
            expect(rows.nth(1)).to_contain_text("the server has it already", timeout=PATIENCE)
            page.evaluate(
                """() => {
                    const data = new DataTransfer();
                    data.items.add(new File(["<script>1</script>"], "<img src=x>.mcap"));
                    document.querySelector(".drop").dispatchEvent(new DragEvent("drop", { dataTransfer: data }));
                }"""
            )
            expect(rows.nth(2)).to_contain_text("<img src=x>.mcap")
            expect(rows.nth(2).locator(".failed")).to_contain_text("expected", timeout=PATIENCE)
            rows.nth(0).get_by_role("link").click()
            expect(page.locator(".count")).to_contain_text("2 episodes")
            assert [told for told in seen.complaints if "status of 400" not in told] == []

    def test_why_a_file_is_refused(self, chromium: Browser, server: str, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=2)
        with Recording(tmp_path / "ppo0.mcap") as recording:
            rewrite_recording(recording, tmp_path / "cut.mcap", episodes=[0])
        (tmp_path / "killed.mcap").write_bytes((tmp_path / "ppo0.mcap").read_bytes()[:-500])
        with opened(chromium, server) as (page, _):
            field = upload_field(page)
            field.set_input_files([tmp_path / f"{name}.mcap" for name in ("ppo0", "cut", "killed")])
            refused = page.locator(".uploads .failed")
            expect(refused.nth(0)).to_contain_text("which this file lacks", timeout=PATIENCE)
            expect(refused.nth(1)).to_contain_text("expected a finished recording", timeout=PATIENCE)
            expect(refused.nth(1)).to_contain_text("tupli-mcap recover FILE")
            name, why = (
                page.locator(".uploads li").nth(2).locator("bdi").bounding_box(),
                refused.nth(1).bounding_box(),
            )
            assert name is not None and why is not None and name["y"] + name["height"] <= why["y"]

    def test_after_a_file_that_cannot_be_read_come_the_others(
        self, chromium: Browser, server: str, tmp_path: Path
    ) -> None:
        carts(tmp_path, seeds=2, episodes=1)
        with opened(chromium, server) as (page, _):
            field = upload_field(page)
            moved = tmp_path / "ppo0.mcap"
            page.route("**/sha256.js", lambda route: (moved.unlink(missing_ok=True), route.continue_()))
            field.set_input_files([moved, tmp_path / "ppo1.mcap"])
            rows = page.locator(".uploads li")
            expect(rows.nth(0).locator(".failed")).to_contain_text("cannot be read", timeout=PATIENCE)
            expect(rows.nth(1)).to_contain_text("is here", timeout=PATIENCE)

    def test_an_expired_token_is_renewed(self, chromium: Browser, server: str, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=1)
        with opened(chromium, server) as (page, _):
            field = upload_field(page)
            expired = {"status": 401, "json": {"detail": "the token has expired"}}
            page.route("**/v1/uploads", lambda route: route.fulfill(**expired), times=1)
            field.set_input_files(tmp_path / "ppo0.mcap")
            expect(page.locator(".uploads")).to_contain_text("is here", timeout=PATIENCE)

    def test_a_file_that_another_page_has_sent_meanwhile(
        self, chromium: Browser, server: str, tmp_path: Path
    ) -> None:
        """Both continue the same upload, which is gone once one of them has sent the last bytes."""
        carts(tmp_path, seeds=1, episodes=1)
        with opened(chromium, server) as (page, _):
            field = upload_field(page)

            def later(route: Route) -> None:
                route.fetch()
                route.continue_()

            page.route("**/v1/uploads/*", later, times=1)
            field.set_input_files(tmp_path / "ppo0.mcap")
            expect(page.locator(".uploads")).to_contain_text("the server has it already", timeout=PATIENCE)

    def test_trying_again_when_the_server_can_be_reached(
        self, chromium: Browser, server: str, tmp_path: Path
    ) -> None:
        carts(tmp_path, seeds=1, episodes=1)
        with opened(chromium, server) as (page, _):
            field = upload_field(page)
            page.clock.install()
            page.context.set_offline(True)
            field.set_input_files(tmp_path / "ppo0.mcap")
            failed = page.locator(".uploads .failed")
            wait_for(lambda: page.clock.run_for(5000) or failed.count())
            expect(failed).to_contain_text("the server cannot be reached")
            page.clock.resume()
            page.context.set_offline(False)
            page.get_by_role("button", name="Try again").click()
            expect(page.locator(".uploads")).to_contain_text("is here", timeout=PATIENCE)
            expect(page.get_by_role("button", name="Try again")).to_have_count(0)

    def test_a_page_that_uploads_is_not_left_by_mistake(
        self, chromium: Browser, server: str, tmp_path: Path
    ) -> None:
        carts(tmp_path, seeds=1, episodes=2)
        with opened(chromium, server) as (page, _):
            upload_field(page)
            held: list[Route] = []
            page.route("**/v1/uploads", lambda route: held.append(route))
            data = base64.b64encode((tmp_path / "ppo0.mcap").read_bytes()).decode()
            refused = page.evaluate(
                """(data) => {
                    const transfer = new DataTransfer();
                    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
                    transfer.items.add(new File([bytes], "ppo0.mcap"));
                    const dropped = { dataTransfer: transfer, bubbles: true, cancelable: true };
                    return !document.querySelector("h1").dispatchEvent(new DragEvent("drop", dropped));
                }""",
                data,
            )
            assert refused  # by the page, so that the browser does not open the file
            wait_for(lambda: page.wait_for_timeout(50) or held)
            dialogs: list[str] = []
            page.on("dialog", lambda dialog: (dialogs.append(dialog.type), dialog.dismiss()))
            page.locator("h1").click()  # browsers ask only who has used the page
            page.get_by_role("link", name="Groups").click(no_wait_after=True)
            wait_for(lambda: page.wait_for_timeout(50) or dialogs)
            held[0].continue_()
            expect(page.locator(".uploads")).to_contain_text("is here", timeout=PATIENCE)
            page.get_by_role("link", name="Groups").click()
            expect(page.get_by_role("heading", name="Groups")).to_be_visible()
            assert dialogs == ["beforeunload"]

    def test_goes_on_after_a_restart_of_the_server(self, chromium: Browser, tmp_path: Path) -> None:
        carts(tmp_path, seeds=2, episodes=1)
        with served(tmp_path / "served") as process, opened(chromium, process.url) as (page, _):
            field = upload_field(page)
            rows = page.locator(".uploads li")
            field.set_input_files(tmp_path / "ppo0.mcap")
            expect(rows.nth(0)).to_contain_text("is here", timeout=PATIENCE)
            process.kill()
            with page.expect_event("requestfailed"):
                field.set_input_files(tmp_path / "ppo1.mcap")
            process.start()
            expect(rows.nth(1)).to_contain_text("is here", timeout=PATIENCE)

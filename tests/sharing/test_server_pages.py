"""The page of a server: signing in, what each may see, and forms that nobody else can send."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urljoin, urlsplit

import httpx
import pytest
from pages import carts, robot
from serving import ENGINES, PASSWORD, serving, settings_of

import tupli_mcap
from tupli_mcap.page.routes import PAGES
from tupli_mcap.schema import Right
from tupli_mcap.server.pages import PAGES as OF_SERVERS
from tupli_mcap.server.people.access import DEFAULT_ROLES
from tupli_mcap.server.settings import Settings

COOKIE = "tupli_mcap_session"
CODE = re.compile(r'name="code" value="([0-9a-f]{64})"')
OPEN_TO_ALL = {"/", "/sign-in", "/static/{name}", "/viewer/{number}/{name}"}
"""Addresses that say nothing of what is kept."""
OF_DATA = {
    "/dataset/{key:path}", "/cover/{key:path}", "/episode/{uri}", "/episode/{uri}/step/{step}",
    "/episode/{uri}/picture/{camera}/{place}", "/episode/{uri}/film.mp4", "/compare", "/sparks", "/download", "/viewer",
    "/replay.rrd", "/share", "/group",
}  # fmt: skip
"""Addresses of something that is not there for who may not read it."""


class Api:
    """The programming interface, as somebody uses it."""

    def __init__(self, url: str, name: str) -> None:
        told = {"username": name, "password": PASSWORD if name == "admin" else f"{name}'s password"}
        token = httpx.post(f"{url}/v1/tokens", json=told).json()["access_token"]
        self._url, self._headers = url, {"Authorization": f"Bearer {token}"}

    def post(self, address: str, **told: Any) -> Any:
        answer = httpx.post(self._url + address, json=told, headers=self._headers)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def send(self, path: Path) -> None:
        data = path.read_bytes()
        digest = base64.b64encode(hashlib.sha256(data).hexdigest().encode()).decode()
        headers = {**self._headers, "Upload-Length": str(len(data)), "Upload-Metadata": f"sha256 {digest}"}
        place = self._url + httpx.post(f"{self._url}/v1/uploads", headers=headers).headers["Location"]
        sent = httpx.patch(place, headers={**self._headers, "Upload-Offset": "0"}, content=data)
        assert sent.status_code == 204, sent.text

    def publish(self, *ids: str, published: bool = True) -> None:
        wanted = {"type": "IN", "key": "id", "value": list(ids)}
        self.post("/v1/episodes/publish", filter=wanted, group="global", published=published)


@pytest.fixture(scope="module", params=ENGINES)
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("server")
    with settings_of(request.param, request, root / "kept") as settings, serving(settings) as url:
        for name in ("ann", "bob"):
            Api(url, "admin").post("/v1/users", username=name, password=f"{name}'s password")
        (root / "ann").mkdir()
        carts(root / "ann", seeds=1, episodes=6)
        robot(root / "ann" / "robot.mcap", text="a secret task")
        for path in sorted((root / "ann").glob("*.mcap")):
            Api(url, "ann").send(path)
        yield url


@contextlib.contextmanager
def browser(url: str, name: str = "", password: str = "") -> Iterator[httpx.Client]:
    """A browser, in which somebody is signed in."""
    with httpx.Client(base_url=url, headers={"Accept": "text/html"}, timeout=60) as client:
        if name:
            told = {"username": name, "password": password or f"{name}'s password", "next": "/episodes"}
            answer = client.post("/sign-in", data=told)
            assert (answer.status_code, answer.headers["location"]) == (303, "/episodes")
        yield client


def code(client: httpx.Client, address: str = "/account") -> str:
    found = CODE.search(client.get(address).text)
    assert found
    return found[1]


def episodes_of(client: httpx.Client, **params: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get("/episodes", params={**params, "format": "json"}).json()[
        "episodes"
    ]
    return found


def test_a_browser_keeps_pictures_for_one_sign_in(server: str) -> None:
    with browser(server, "ann") as client:
        for address in ("/cover/CartPole-v1", "/cover/-"):
            kept = client.get(address).raise_for_status().headers
            assert kept["cache-control"] == "private, max-age=3600"
            assert "Cookie" in kept["vary"]
    with browser(server, "bob") as client:
        assert client.get("/cover/CartPole-v1").status_code == 404


def test_a_server_without_recordings_says_how_to_send_some(tmp_path: Path) -> None:
    with serving(Settings(tmp_path / "kept", guests=True)) as url:
        with browser(url, "admin", PASSWORD) as client:
            shown = client.get("/", headers={"Accept": "text/html"}).text
        guest = httpx.get(url, headers={"Accept": "text/html"}).text
    assert (
        f"tupli-mcap push runs/*.mcap --url {url}" in shown and 'href="/upload">Upload recordings<' in shown
    )
    assert "nothing here yet that you may see" in guest and "push" not in guest


def test_foxglove_opens_exactly_the_chosen_episodes(tmp_path: Path) -> None:
    loader = "https://loader.example.org/"
    with serving(Settings(tmp_path / "kept", loader=loader)) as url:
        carts(tmp_path, seeds=2, episodes=3)
        for path in sorted(tmp_path.glob("*.mcap")):
            Api(url, "admin").send(path)
        with browser(url, "admin", PASSWORD) as client:
            told = client.get("/episodes", params={"format": "json"}).json()["episodes"]
            chosen = [told[0]["id"], told[2]["id"], told[3]["id"]]
            shown = client.get("/compare", params={"episode": chosen}).text
        link = re.search(r'href="(https://app.foxglove.dev/[^"]*)"[^>]*>Open in Foxglove<', shown)
        assert link
        asked = parse_qs(urlsplit(html.unescape(link[1])).query)
        assert (asked["ds"], asked["ds.dataLoaderUrl"]) == (["remote-data-loader"], [loader])
        sources = httpx.get(f"{url}/v1/manifest", params={"ticket": asked["ds.ticket"]}).json()["sources"]
        found = []
        for number, source in enumerate(sources):
            path = tmp_path / f"got{number}.mcap"
            path.write_bytes(httpx.get(urljoin(f"{url}/v1/manifest", source["url"])).content)
            found += [episode.id for episode in tupli_mcap.open(path)]
        assert found == chosen


def test_an_address_of_no_page_is_answered_as_by_browse(server: str) -> None:
    for path in ("/nope", "/episodes/nope"):
        page = httpx.get(server + path, headers={"Accept": "text/html"})
        assert page.status_code == 404 and "<h1>Not here</h1>" in page.text, page.text
        told = httpx.get(server + path, params={"format": "json"})
        assert (told.status_code, told.json()) == (404, {"error": "there is no page at this address"})
    with browser(server, "ann") as ann:
        page = ann.get("/nope")
        assert page.status_code == 404 and '<a href="/account">ann</a>' in page.text, page.text
    for path in ("/nope", "/v1/nope"):  # of a program
        detail = f"there is no route GET {path}; /openapi.json lists what there is"
        assert httpx.get(server + path).json() == {"detail": detail, "error": "NotFoundError"}


class TestSigningIn:
    def test_who_is_not_signed_in_is_sent_there_and_back(self, server: str) -> None:
        with browser(server) as guest:
            answer = guest.get("/episodes?sort=-return")
            assert answer.status_code == 303
            place = urlsplit(answer.headers["location"])
            assert (place.path, parse_qs(place.query)) == ("/sign-in", {"next": ["/episodes?sort=-return"]})
            assert guest.get("/episodes?format=json").status_code == 401
            assert guest.get("/", headers={"Accept": "*/*"}).json()["name"] == "tupli-mcap"
            assert (guest.head("/").status_code, guest.head("/", headers={"Accept": "*/*"}).status_code) == (
                303,
                200,
            )

    def test_the_cookie(self, server: str) -> None:
        with browser(server) as client:
            answer = client.post("/sign-in", data={"username": "ann", "password": "ann's password"})
            cookie = answer.headers["set-cookie"]
            assert "HttpOnly" in cookie and "SameSite=lax" in cookie and "Path=/" in cookie
            account = client.get("/account")
            assert account.status_code == 200
            assert re.search(r"<h2>Stored</h2>\n<p>[\d.]+ [kMG]?B</p>", account.text)

    @pytest.mark.parametrize(
        "address",
        ["https://evil.example/", "//evil.example", "/\\evil.example", "javascript:alert(1)", "/\r\nX: y"],
    )
    def test_it_never_leads_elsewhere(self, server: str, address: str) -> None:
        with browser(server) as client:
            told = {"username": "ann", "password": "ann's password", "next": address}
            assert client.post("/sign-in", data=told).headers["location"] == "/"
            assert client.get("/sign-in", params={"next": address}).headers["location"] == "/"

    def test_wrong_passwords(self, server: str) -> None:
        with browser(server) as client:
            wrong = {
                client.post("/sign-in", data={"username": u, "password": "x"}).text for u in ("ann", "nobody")
            }
            assert len({text.replace("nobody", "ann") for text in wrong}) == 1
            assert "Incorrect username or password" in wrong.pop()
            assert COOKIE not in client.cookies

    def test_signing_out_ends_it_everywhere(self, server: str) -> None:
        with browser(server, "ann") as client:
            session = client.cookies[COOKIE]
            assert client.post("/sign-out", data={"code": code(client)}).status_code == 303
            assert client.get("/account").status_code == 303
            late = client.post("/account/password", data={"code": "", "old": "x", "new": "y"})
            assert late.status_code == 401 and '<a href="/sign-in">Sign in</a>' in late.text
        with httpx.Client(base_url=server, cookies={COOKIE: session}) as thief:
            assert thief.get("/account").status_code == 303

    def test_a_new_password_ends_the_others(self, server: str) -> None:
        with browser(server, "bob") as here, browser(server, "bob") as there:
            told = {"code": code(here), "old": "wrong", "new": "n"}
            refused = here.post("/account/password", data=told)
            assert (refused.status_code, refused.text.count("the old password is not right")) == (403, 1)
            told["old"], told["new"] = "bob's password", "another password"
            changed = here.post("/account/password", data=told)
            assert changed.status_code == 303
            shown = [here.get(changed.headers["location"]) for _ in range(2)]
            assert [page.status_code for page in shown] == [200, 200]
            assert ["Your password was changed" in page.text for page in shown] == [True, False]
            assert there.get("/account").status_code == 303
            told = {"code": code(here), "old": "another password", "new": "bob's password"}
            assert here.post("/account/password", data=told).status_code == 303

    def test_the_programming_interface_takes_no_cookie(self, server: str) -> None:
        with browser(server, "ann") as client:
            assert client.get("/v1/me").status_code == 401
            assert client.post("/v1/episodes/delete", json={"filter": None}).status_code == 401

    def test_a_program_sends_a_token(self, server: str) -> None:
        made = Api(server, "ann").post("/v1/api-tokens", name="robot", scope="write")
        own, wrong = ({"Authorization": f"Bearer {text}"} for text in (made["token"], "nonsense"))
        with browser(server, "ann") as ann, httpx.Client(base_url=server, headers=own) as program:
            assert episodes_of(program) == episodes_of(ann) != []
            assert program.get(f"/episode/{episodes_of(ann)[0]['id']}?format=json").status_code == 200
            assert program.get("/account?format=json").status_code == 401
            assert program.post("/groups", data={"code": code(ann), "name": "robots"}).status_code == 401
            refused = ann.get("/episodes?format=json", headers=wrong)  # whatever the cookie says
            assert (refused.status_code, list(refused.json())) == (401, ["error"])
            assert program.delete(f"/v1/api-tokens/{made['id']}").status_code == 200
            assert program.get("/episodes?format=json").status_code == 401

    def test_only_an_open_server_takes_everybody(self, server: str, tmp_path: Path) -> None:
        told = {"username": "eve", "password": "eve's password", "new": "1"}
        with browser(server) as client:
            assert client.post("/sign-in", data=told).status_code == 403
        with serving(Settings(tmp_path, open_signup=True)) as url, browser(url) as client:
            assert "I have no account yet" in client.get("/sign-in").text
            assert client.post("/sign-in", data=told).status_code == 303
            assert client.get("/account").status_code == 200


def forms() -> list[str]:
    return sorted(route.path for router in OF_SERVERS for route in router.routes if "POST" in route.methods)  # type: ignore[attr-defined]


OF_ONES_OWN = {
    "/sign-in", "/sign-out", "/account/access", "/account/password", "/account/tokens",
    "/account/tokens/delete",
}  # fmt: skip
OF_RIGHTS = [
    (Right.EPISODE_CREATE, "/share", "/share?dataset=-", {"dataset": "-", "group": "global"}),
    (Right.GROUP_CREATE, "/groups", "/groups", {"name": "another crew"}),
    (Right.GROUP_UPDATE, "/group/members", "/group?name=crew", {"name": "crew", "user": "bob"}),
    (Right.GROUP_UPDATE, "/group/members/delete", "/group?name=crew", {"name": "crew", "user": "ann"}),
    (Right.GROUP_DELETE, "/group/delete", "/group?name=crew", {"name": "crew"}),
    (Right.USER_CREATE, "/users", "/users", {"username": "cid", "password": "cid's password"}),
    (Right.USER_UPDATE, "/users/quota", "/users", {"username": "bob", "gigabytes": "1"}),
    (Right.USER_DELETE, "/users/delete", "/users", {"username": "bob"}),
]
"""Forms that need a right: the right, the address, the page that has the form, and what may be in it."""


class TestForms:
    @pytest.mark.parametrize(("right", "address", "page", "told"), OF_RIGHTS)
    def test_they_are_there_for_those_who_may(
        self,
        server: str,
        monkeypatch: pytest.MonkeyPatch,
        right: Right,
        address: str,
        page: str,
        told: dict[str, str],
    ) -> None:
        """Everybody has several default roles, so that a user lacks a right only if each of these does."""

        def give(rights: frozenset[Right]) -> None:
            for role in DEFAULT_ROLES:
                monkeypatch.setitem(DEFAULT_ROLES, role, rights)

        with browser(server, "ann") as ann:
            give(frozenset(Right))
            told = {**told, "code": code(ann)}
            ann.post("/groups", data={**told, "name": "crew"})
            form = f'method="post" action="{address}"'
            assert form in ann.get(page).text
            give(frozenset(Right) - {right})
            without = ann.get(page)
            assert (without.status_code, form in without.text) == (200, False)
            assert ann.post(address, data=told).status_code in (403, 404)

    def test_each_is_one_s_own_or_needs_a_right(self) -> None:
        assert {address for _, address, *_ in OF_RIGHTS} | OF_ONES_OWN == set(forms())

    def test_links_to_pages_are_there_for_those_who_may(
        self, server: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with browser(server, "ann") as ann:
            for right, page in ((Right.EPISODE_CREATE, "/upload"), (Right.USER_READ, "/users")):
                assert (f'href="{page}"' in ann.get("/").text, ann.get(page).status_code) == (True, 200)
                with monkeypatch.context() as patch:
                    for role, rights in DEFAULT_ROLES.items():
                        patch.setitem(DEFAULT_ROLES, role, rights - {right})
                    assert (f'href="{page}"' in ann.get("/").text, ann.get(page).status_code) == (False, 403)

    @pytest.mark.parametrize("address", [path for path in forms() if path != "/sign-in"])
    def test_they_need_their_code(self, server: str, address: str) -> None:
        """Every form of every page, so that none is forgotten."""
        with browser(server, "ann") as ann, browser(server, "bob") as bob:
            own = code(ann)
            for told in ({}, {"code": ""}, {"code": "0" * 64}, {"code": code(bob)}):
                assert ann.post(address, data=told).status_code == 403
            for headers in (
                {"Origin": "https://evil.example"},
                {"Sec-Fetch-Site": "cross-site"},
                {"Origin": "null"},
                {"Origin": "http://["},
            ):
                assert ann.post(address, data={"code": own}, headers=headers).status_code == 403
        with browser(server) as guest:
            assert guest.post(address, data={"code": own}).status_code == 401

    def test_signing_in_from_elsewhere(self, server: str) -> None:
        with browser(server) as client:
            told = {"username": "ann", "password": "ann's password"}
            for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
                assert client.post("/sign-in", data=told, headers=headers).status_code == 403
            own = {"Origin": server, "Sec-Fetch-Site": "same-origin"}
            assert client.post("/sign-in", data=told, headers=own).status_code == 303


def readable_addresses(client: httpx.Client) -> dict[str, str]:
    """An address of every page, made for what a user owns: by its route."""
    robots = episodes_of(client, filter='recording != "x" and not run.environment == "CartPole-v1"')
    carts = episodes_of(client, filter='run.environment == "CartPole-v1"')
    uri, two = robots[0]["id"], f"episode={carts[0]['id']}&episode={carts[1]['id']}"
    return {
        "/": "/",
        "/episodes": "/episodes",
        "/dataset/{key:path}": "/dataset/-",
        "/cover/{key:path}": "/cover/-",
        "/episode/{uri}": f"/episode/{uri}",
        "/episode/{uri}/step/{step}": f"/episode/{uri}/step/1",
        "/episode/{uri}/picture/{camera}/{place}": f"/episode/{uri}/picture/0/1",
        "/episode/{uri}/film.mp4": f"/episode/{uri}/film.mp4",
        "/compare": f"/compare?{two}",
        "/sparks": f"/sparks?{two}",
        "/download": f"/download?{two}",
        "/viewer": f"/viewer?episode={uri}",
        "/replay.rrd": f"/replay.rrd?episode={uri}",
        "/share": "/share?dataset=-",
        "/sign-in": "/sign-in",
        "/account": "/account",
        "/users": "/users",
        "/groups": "/groups",
        "/group": "/group?name=theirs",
        "/upload": "/upload",
        "/static/{name}": "/static/page.css",
        "/viewer/{number}/{name}": "/viewer/0/x",
    }


class TestWhoSeesWhat:
    def test_every_page_for_its_owner_for_others_and_for_guests(self, server: str) -> None:
        pages = {
            route.path: route
            for router in (*PAGES, *OF_SERVERS)
            for route in router.routes
            if "GET" in route.methods
        }  # type: ignore[attr-defined]
        with browser(server, "ann") as ann, browser(server, "bob") as bob, browser(server) as guest:
            ann.post("/groups", data={"code": code(ann), "name": "theirs"})
            addresses = readable_addresses(ann)
            assert set(addresses) == set(pages), "a page that this test does not know"
            ids = [e["id"] for e in episodes_of(ann)]
            for route, address in addresses.items():
                own, other, nobody = (client.get(address) for client in (ann, bob, guest))
                unasked = [uri for uri in ids if uri not in address]
                secrets = re.compile("|".join(["a secret task", "CartPole", *unasked]))
                if route not in ("/viewer/{number}/{name}", "/sign-in"):
                    assert own.status_code == 200, address
                assert not secrets.search(other.text), address
                about_data = "episode" in route or route in (
                    "/compare",
                    "/sparks",
                    "/download",
                    "/viewer",
                    "/replay.rrd",
                )
                if (about_data and route != "/episodes") or "key" in route or route == "/share":
                    assert other.status_code == 404, address
                if route not in OPEN_TO_ALL:
                    assert nobody.status_code == 303, address
                    assert nobody.headers["location"].startswith("/sign-in?")
                assert not secrets.search(nobody.text), address

    def test_published_episodes_alone(self, server: str) -> None:
        """Two of six are published: pages and files of the recording are of these two."""
        api = Api(server, "ann")
        with browser(server, "ann") as ann, browser(server, "bob") as bob:
            carts = [e["id"] for e in episodes_of(ann, dataset="CartPole-v1")]
            api.publish(*carts[1:3])
            try:
                seen = episodes_of(bob)
                assert [e["id"] for e in seen] == carts[1:3]
                (dataset,) = bob.get("/?format=json").json()["datasets"]
                assert (dataset["episodes"], dataset["steps"]) == (2, sum(e["n_tuples"] for e in seen))
                (whole,) = [
                    d for d in ann.get("/?format=json").json()["datasets"] if d["key"] == "CartPole-v1"
                ]
                assert whole["episodes"] == 6 and whole["bytes"] > 0
                address = "/dataset/CartPole-v1"
                part, files = (bob.get(f"{address}?format=json").json()[name] for name in ("bytes", "files"))
                assert (dataset["bytes"], part, files[0]["bytes"]) == (None, None, None)
                recording, owner = files[0]["recording"], files[0]["owner"]
                assert '<td class="value"><bdi>ann</bdi></td>' in bob.get(address).text
                assert "<dt>Owner</dt><dd>ann</dd>" in bob.get(f"/episode/{carts[1]}").text
                assert owner == "ann"
                ticket = Api(server, "bob").post("/v1/tickets", recording=recording)
                assert (ticket["whole"], ticket["size"], ticket["episodes"]) == (False, 0, 0)
                head, got = (httpx.request(method, server + ticket["path"]) for method in ("HEAD", "GET"))
                assert (head.status_code, got.status_code) == (200, 200) and got.content
                assert "content-length" not in head.headers
                assert head.headers["content-type"] == got.headers["content-type"]
                assert "<dt>Size</dt><dd>–</dd>" in bob.get(address).text
                assert "<dt>Size</dt><dd>–</dd>" not in ann.get(address).text
                text = bob.get("/dataset/CartPole-v1").text
                assert f"in {sum(e['n_tuples'] for e in seen):,} steps of 2 episodes" in text
                assert bob.get(f"/episode/{carts[0]}").status_code == 404
                assert bob.get(f"/episode/{carts[1]}?step=1").status_code == 200
                got = bob.get("/download", params={"dataset": "CartPole-v1"}).content
                assert got.startswith(b"\x89MCAP")
                replay = bob.get("/replay.rrd", params={"episode": carts[1]}).content
                assert b"6 terminal" not in replay
                text = bob.get(f"/episode/{carts[1]}").text
                assert "foxglove" not in text and "as you may read only a part of it" in text
                link = re.search(
                    'href="(https://app.foxglove.dev/[^"]*)"', ann.get(f"/episode/{carts[1]}").text
                )
                assert link
                url = parse_qs(urlsplit(link[1].replace("&amp;", "&")).query)["ds.url"][0]
                with tupli_mcap.Recording(url) as recording:
                    assert len(recording) == 6
            finally:
                api.publish(*carts[1:3], published=False)

    def test_whose_a_dataset_without_a_benchmark_is(self, tmp_path: Path) -> None:
        names = ["ann", "bob", "cid", "dan", "eve"]
        carts(tmp_path, seeds=1, episodes=3)
        with serving(Settings(tmp_path / "kept")) as url, browser(url, "admin", PASSWORD) as admin:

            def card() -> tuple[str, dict[str, Any]]:
                dataset = admin.get("/?format=json").json()["datasets"][0]
                pages = [admin.get(address).text for address in ("/", f"/dataset/{dataset['key']}")]
                told = [" · ".join(re.findall(r"<bdi>([^<]*)</bdi> · <bdi>([^<]*)<", pages[0])[0])]
                told += re.findall(r"<dt>(?:Owners?|Seen by)</dt><dd>([^<]*)<", pages[1])
                assert told[0] == " · ".join(told[1:])
                return told[0], dataset

            for name in names:
                Api(url, "admin").post("/v1/users", username=name, password=f"{name}'s password")
                Api(url, name).send(tmp_path / "ppo0.mcap")
                with browser(url, name) as client:
                    wanted = {"code": code(client), "dataset": "CartPole-v1", "group": "global"}
                    assert client.post("/share", data=wanted).status_code == 303
                if name == "ann":
                    told, dataset = card()
                    assert (told, dataset["owner"], dataset["published_in"]) == (
                        "ann · global",
                        "ann",
                        ["ann", "global"],
                    )
            told, dataset = card()
            assert told == "ann, bob, cid and 2 more · global"
            assert (dataset["owner"], dataset["owners"]) == (None, names)
            assert admin.get("/?q=eve&format=json").json()["count"] == 1
            with browser(url, "ann") as ann:
                own = episodes_of(ann)[0]["id"]
                Api(url, "ann").publish(own, published=False)
                assert "<bdi>global, private</bdi>" in ann.get("/").text


class TestPeople:
    def test_publishing_as_a_whole(self, server: str) -> None:
        with browser(server, "ann") as ann, browser(server, "bob") as bob:
            told = {"code": code(ann), "dataset": "-", "group": "global"}
            assert ann.post("/share", data=told).status_code == 303
            assert len(episodes_of(bob)) == 2
            assert ">global<" in ann.get("/share?dataset=-").text
            assert bob.post("/share", data={**told, "code": code(bob)}).status_code == 403
            form = '<form method="post" action="/share"'
            assert [form in each.get("/share?dataset=-").text for each in (ann, bob)] == [True, False]
            assert "Nothing of this is yours" in bob.get("/share?dataset=-").text
            for page in ("/dataset/-", "/episodes?dataset=-"):
                assert ["/share?" in each.get(page).text for each in (ann, bob)] == [True, False]
            assert ann.post("/share", data={**told, "published": "false"}).status_code == 303
            assert episodes_of(bob) == []
            assert ann.post("/share", data={**told, "group": "nobody's"}).status_code == 403
            some = {**told, "filter": "metadata.success == true"}
            assert ann.post("/share", data=some).status_code == 303
            assert [e["metadata"]["success"] for e in episodes_of(bob)] == [True]
            assert ann.post("/share", data={**some, "published": "false"}).status_code == 303
            none = ann.post("/share", data={**told, "filter": "steps = 999"})
            assert (none.status_code, "no episode of yours" in none.text) == (400, True)
            wrong = ann.post("/share", data={**told, "filter": "steps >"})
            assert (wrong.status_code, "needs a value" in wrong.text) == (400, True)

    def test_publishing_for_one_user_and_taking_it_back(self, server: str) -> None:
        with browser(server, "ann") as ann, browser(server, "bob") as bob:
            told = {"code": code(ann), "dataset": "-", "group": "bob"}
            assert ann.post("/share", data={**told, "filter": "episode = 0"}).status_code == 303
            assert len(episodes_of(bob)) == 1
            shown = ann.get("/share?dataset=-").text
            assert (
                '<select name="group"><option>bob</option></select>' in shown
            )  # in which it can be unpublished
            assert ann.post("/share", data={**told, "published": "false"}).status_code == 303
            assert episodes_of(bob) == []
            assert ">Unpublish<" not in ann.get("/share?dataset=-").text

    def test_groups(self, server: str) -> None:
        with browser(server, "ann") as ann:
            assert "seen by everybody who is signed in" in ann.get("/groups").text
        with browser(server, "ann") as ann, browser(server, "bob") as bob:
            own = code(ann)
            assert ann.post("/groups", data={"code": own, "name": "arms & <legs>"}).status_code == 303
            assert ann.post("/groups", data={"code": own, "name": "bob"}).status_code == 409
            assert bob.get("/group", params={"name": "arms & <legs>"}).status_code == 404
            told = {"code": own, "name": "arms & <legs>", "user": "bob", "role": "member"}
            assert ann.post("/group/members", data=told).status_code == 303
            assert "bob" in bob.get("/group", params={"name": "arms & <legs>"}).text
            assert (
                bob.post("/group/members", data={**told, "code": code(bob), "user": "ann"}).status_code == 403
            )
            ann.post("/share", data={"code": own, "dataset": "-", "group": "arms & <legs>"})
            assert len(episodes_of(bob)) == 2
            assert ann.post("/group/members/delete", data=told).status_code == 303
            assert episodes_of(bob) == []
            shared = {"code": own, "dataset": "-", "group": "global"}
            ann.post("/share", data=shared)
            ids = [each["id"] for each in episodes_of(bob)]
            both = f"/compare?episode={ids[0]}&episode={ids[1]}&"
            for address in ("/users?", "/share?dataset=-&", f"/episode/{ids[0]}?", both, "/episodes?"):
                shown = bob.get(f"{address}format=json")  # not the group, which bob is not in
                assert (shown.status_code, "legs" in shown.text, "global" in shown.text) == (200, False, True)
            ann.post("/share", data={**shared, "published": "false"})
            assert ann.post("/group/delete", data=told).status_code == 303
            assert "legs" not in ann.get("/share?dataset=-").text

    def test_links_to_groups_lead_somewhere(self, server: str) -> None:
        with browser(server, "ann") as ann, browser(server, "bob") as bob:
            own, crew = code(ann), {"name": "readers"}
            ann.post("/groups", data={"code": own, **crew})
            ann.post("/group/members", data={"code": own, **crew, "user": "bob", "role": "guest"})
            assert 'href="/group?name=readers"' in ann.get("/groups").text
            page = bob.get(
                "/groups"
            ).text  # a guest of a group reads what is published in it, and not its members
            assert "readers" in page
            assert "/group?name=readers" not in page
            left = ann.post("/group/members/delete", data={"code": own, **crew, "user": "ann"})
            assert ann.get(left.headers["location"]).status_code == 200

    def test_users(self, server: str) -> None:
        with browser(server, "ann") as ann, browser(server, "admin", PASSWORD) as admin:
            told = {"username": "carl", "password": "carl's password"}
            assert ann.post("/users", data={**told, "code": code(ann)}).status_code == 403
            assert admin.post("/users", data={**told, "code": code(admin)}).status_code == 303
            assert admin.post("/users", data={**told, "code": code(admin)}).status_code == 409
            assert "carl" in ann.get("/users").text
            assert ann.post("/users/delete", data={**told, "code": code(ann)}).status_code == 403
            assert admin.post("/users/delete", data={**told, "code": code(admin)}).status_code == 303

    def test_quotas(self, server: str) -> None:
        with browser(server, "ann") as ann, browser(server, "admin", PASSWORD) as admin:

            def stored() -> dict[str, Any]:
                told: dict[str, Any] = admin.get("/users?format=json").json()["stored"]["ann"]
                return told

            used = ann.get("/account?format=json").json()["used"]
            assert used > 0
            assert stored() == {"used": used, "quota": None, "own_quota": None}
            for text in ("Stored", "Quota", "/users/quota"):
                assert (text in admin.get("/users").text, text in ann.get("/users").text) == (True, False)
            assert list(ann.get("/users?format=json").json()) == ["users"]
            told = {"username": "ann", "gigabytes": "1.5"}
            assert ann.post("/users/quota", data={**told, "code": code(ann)}).status_code == 403
            told["code"] = code(admin)
            assert admin.post("/users/quota", data=told).status_code == 303
            assert stored() == {"used": used, "quota": 1_500_000_000, "own_quota": 1_500_000_000}
            shown = admin.get("/users").text
            assert "B of 1.5 GB</td>" in shown and 'value="1.5" aria-label="Quota of ann in GB"' in shown
            for wrong in ("-1", "nan", "inf", "1e10", "much"):
                refused = admin.post("/users/quota", data={**told, "gigabytes": wrong})
                assert (refused.status_code, "gigabytes: Input should be" in refused.text) == (400, True)
            nobody = admin.post("/users/quota", data={**told, "username": "nobody"})
            assert (nobody.status_code, "User does not exist" in nobody.text) == (404, True)
            assert admin.post("/users/quota", data={**told, "gigabytes": ""}).status_code == 303
            assert stored()["quota"] is None

    def test_tokens_of_machines(self, server: str) -> None:
        with browser(server, "ann") as ann:
            made = ann.post("/account/tokens", data={"code": code(ann), "name": "node 7", "scope": "read"})
            token = re.search("<pre>(tmcap_[^<]*)</pre>", made.text)
            assert token
            machine = {"Authorization": f"Bearer {token[1]}"}
            assert httpx.get(f"{server}/v1/me", headers=machine).json()["username"] == "ann"
            assert token[1] not in ann.get("/account").text
            number = ann.get("/account?format=json").json()["tokens"][0]["id"]
            assert (
                ann.post("/account/tokens/delete", data={"code": code(ann), "token": number}).status_code
                == 303
            )
            assert httpx.get(f"{server}/v1/me", headers=machine).status_code == 401

    def test_a_refused_form_keeps_what_was_sent_but_no_password(self, server: str) -> None:
        forms = {
            "/sign-in": {"username": "ann", "password": "wrong words"},
            "/groups": {"name": "bob", "description": "those with arms"},
            "/group/members": {"name": "kept", "user": "nobody here", "role": "contributor"},
            "/account/tokens": {"name": "node 8", "scope": "write", "days": "9999"},
            "/users": {"username": "bob", "password": "wrong words"},
        }
        with browser(server, "admin", PASSWORD) as admin, browser(server) as guest:
            own = code(admin)
            assert admin.post("/groups", data={"code": own, "name": "kept"}).status_code == 303
            for address, sent in forms.items():
                who = guest if address == "/sign-in" else admin
                answer = who.post(address, data={**sent, "code": own})
                assert answer.status_code in (400, 401, 404, 409), answer.text
                for name, value in sent.items():
                    kept = f'value="{value}"' in answer.text or f"selected>{value}<" in answer.text
                    kept |= f'value="{value}" selected' in answer.text
                    assert kept == (name not in ("password", "code")), (address, name)
                assert "wrong words" not in answer.text
                assert "This page as JSON" not in answer.text  # which has no address of its own
            admin.post("/group/delete", data={"code": own, "name": "kept"})

    def test_pages_with_codes_are_not_kept(self, server: str) -> None:
        with browser(server, "ann") as ann:
            assert ann.get("/account").headers["cache-control"] == "no-store"


class TestGuests:
    def test_they_see_what_is_published_to_all(self, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=2)
        with serving(Settings(tmp_path / "kept", guests=True)) as url, browser(url) as guest:
            admin = Api(url, "admin")
            admin.send(tmp_path / "ppo0.mcap")
            assert guest.get("/?format=json").json()["datasets"] == []
            admin.post("/v1/episodes/publish", filter=None, group="global")
            assert len(episodes_of(guest)) == 2
            text = guest.get("/dataset/CartPole-v1").text
            assert "Sign in" in text and "Share" not in text
            assert guest.get("/account").status_code == 303
            with browser(url, "admin", PASSWORD) as signed_in:
                for page in ("/groups", "/share?dataset=CartPole-v1"):
                    assert re.search(
                        "everybody, also without a sign-in", signed_in.get(page).text, re.IGNORECASE
                    )

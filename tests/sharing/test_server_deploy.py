"""What is shipped to run a server in containers says what the program, nginx and the page of the operators say."""

from __future__ import annotations

import configparser
import contextlib
import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import nginx
import typer
import yaml
from persons import Person
from serving import serving

from tupli_mcap.cli import app
from tupli_mcap.server.settings import Settings

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "docs/howto/deploy"
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
SERVER: dict[str, Any] = COMPOSE["services"]["server"]
CONTAINER = (DEPLOY / "Containerfile").read_text().replace("\\\n", "")


def serve() -> Any:
    """The command, as the library behind typer has it."""
    group: Any = typer.main.get_command(app)
    return group.commands["serve"]


def parsed(words: list[str]) -> dict[str, Any]:
    """What the program understands of a command; fails where it does not."""
    assert words[0] == "serve"
    params: dict[str, Any] = serve().make_context("serve", list(words[1:])).params
    return params


def instruction(name: str) -> list[str]:
    """What follows each of the instructions of this name in the Containerfile."""
    return re.findall(rf"^{name} (.*)$", CONTAINER, re.MULTILINE)


def test_the_commands_are_understood() -> None:
    (entry,) = instruction("ENTRYPOINT")
    assert yaml.safe_load(entry) == ["tupli-mcap"]
    for words in (SERVER["command"], yaml.safe_load(instruction("CMD")[-1])):
        told = parsed(words)
        assert (str(told["directory"]), told["host"]) == (instruction("VOLUME")[0], "0.0.0.0")
        assert told["port"] == int(instruction("EXPOSE")[0])
    known = {each.envvar for each in serve().params}
    variables = {name for name in SERVER["environment"] if name.startswith("TUPLI_MCAP_")}
    assert variables <= known | {"TUPLI_MCAP_ADMIN_PASSWORD"}


def test_the_unit_says_what_nginx_and_the_program_say() -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    assert unit.read(DEPLOY / "tupli-mcap.service")
    service = unit["Service"]
    program, *words = shlex.split(service["ExecStart"])
    told = parsed(words)
    assert Path(program).name == "tupli-mcap" and told["accel"] == "/files" and told["trusted_proxy"]
    site = (DEPLOY / "nginx.conf.template").read_text()
    assert f"location {told['accel']}/" in site and f"alias {told['directory']}/;" in site
    assert service["ReadWritePaths"] == str(told["directory"])
    if analyze := shutil.which("systemd-analyze"):
        found = subprocess.run(
            [analyze, "verify", str(DEPLOY / "tupli-mcap.service")],
            capture_output=True,
            text=True,
            check=False,
        )
        ours = [line for line in found.stderr.splitlines() if "tupli-mcap.service:" in line]
        assert [line for line in ours if "is not executable" not in line and "User=" not in line] == []


def test_images_have_versions() -> None:
    images = [service["image"] for service in COMPOSE["services"].values() if "build" not in service]
    images += re.findall(r"^FROM (\S+)", CONTAINER, re.MULTILINE)
    tags = [image.partition(":")[2] for image in images]
    assert tags and not {"", "latest"} & set(tags), images


def test_what_the_services_say_of_each_other_is_true() -> None:
    told, services = parsed(SERVER["command"]), COMPOSE["services"]
    (subnet,) = COMPOSE["networks"]["inside"]["ipam"]["config"]
    assert list(told["trusted_proxy"]) == [subnet["subnet"]]
    template = nginx.TEMPLATE.read_text()
    assert f"location {told['accel']}/ {{" in template
    assert f"alias {told['directory']}/;" in template
    assert re.findall(r"\$\{(\w+)\}", template) == ["TUPLI_MCAP_SERVER"] * 2
    proxy = services["nginx"]
    assert proxy["environment"]["TUPLI_MCAP_SERVER"] == f"server:{told['port']}"
    assert re.match(proxy["environment"]["NGINX_ENVSUBST_FILTER"], "TUPLI_MCAP_SERVER")
    mounted = {target: source for source, target, *_ in (each.split(":") for each in proxy["volumes"])}
    assert SERVER["volumes"] == [f"{mounted[str(told['directory'])]}:{told['directory']}"]
    assert "/etc/nginx/tls/certificate.pem" in template and "/etc/nginx/tls" in mounted
    assert DEPLOY / mounted["/etc/nginx/templates/default.conf.template"] == nginx.TEMPLATE
    assert (DEPLOY / SERVER["build"]["context"]).resolve() == ROOT
    assert (ROOT / SERVER["build"]["dockerfile"]).is_file()
    for service in services.values():
        assert set(service.get("depends_on", ())) <= services.keys()
        for volume in service.get("volumes", ()):
            assert volume.startswith(".") or volume.partition(":")[0] in COMPOSE["volumes"]
    bucket = SERVER["environment"]["TUPLI_MCAP_BLOBS"].removeprefix("s3://")
    assert services["bucket"]["command"][-1] == f"/objects/{bucket}"
    environment, store = SERVER["environment"], services["store"]
    assert environment["AWS_ENDPOINT_URL"] == f"http://store{store['command'][1]}"
    assert environment["AWS_ACCESS_KEY_ID"] == store["environment"]["ROOT_ACCESS_KEY"]


def test_what_is_copied_makes_the_wheel(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for words in map(shlex.split, instruction("COPY")):
        for name in words[:-1] if not words[0].startswith("--") else ():
            assert words[-1] in ("./", name)
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, source / name)
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([*build, "--wheel-dir", str(tmp_path), "."], cwd=source, env=environment, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as made:
        names = set(made.namelist())
    wanted = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tupli_mcap/server").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert wanted <= names
    assert any(name.startswith("tupli_mcap/schemas/") for name in names)


def test_changes_can_be_read_as_the_operators_page_says(tmp_path: Path) -> None:
    page = (ROOT / "docs/howto/server.md").read_text()
    (query,) = re.findall(r"`(SELECT .*?;)`", page)
    with serving(Settings(tmp_path)) as url:
        Person(url, "admin").ask("POST", "/v1/users", {"username": "ann", "password": "ann's password"})
        file = f"file:{tmp_path}/server/server.sqlite?mode=ro"
        with contextlib.closing(sqlite3.connect(file, uri=True)) as database:
            when, *newest = database.execute(query).fetchone()
    assert newest == ["admin", "create_user", "ann"] and abs(when - time.time()) < 3600


def test_the_operators_page_tells_of_every_option() -> None:
    page = (ROOT / "docs/howto/server.md").read_text()
    told = {
        option
        for row in re.findall(r"^\| (`--.*?) \|", page, re.MULTILINE)
        for option in re.findall(r"--[\w-]+", row)
    }
    known = {option for each in serve().params for option in each.opts if option.startswith("--")}
    assert told == known - {"--help"}
    for file in DEPLOY.iterdir():
        assert f"(deploy/{file.name})" in page, file.name

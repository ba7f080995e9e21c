"""What the page on servers shows first, done by two people in processes of their own, each in a directory of theirs."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import free_port

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "server.md").read_text()
SECTION = PAGE.split("\n## From one user to another\n")[1].split("\n## ")[0]
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", SECTION, re.DOTALL)


class Person:
    """Runs what stands on the page, with the server's real port, on a machine of their own."""

    def __init__(self, home: Path, port: int) -> None:
        self.home, self._port = home, port
        home.mkdir()
        places = {f"TUPLI_MCAP_{each}_DIR": str(home / f".{each}") for each in ("CONFIG", "DATA", "CACHE")}
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self.environment = {**os.environ, **places, "PATH": path}

    def run(self, command: str, **variables: str) -> str:
        done = subprocess.run(
            ["bash", "-c", command.replace("8080", str(self._port))],
            cwd=self.home,
            env={**self.environment, **variables},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, ""), command
        return done.stdout

    def python(self, code: str) -> str:
        (self.home / "script.py").write_text(code.replace("8080", str(self._port)))
        return self.run(f"{sys.executable} -W error script.py")


def commands(block: str) -> Iterator[str]:
    for line in block.splitlines():
        assert line.startswith("$ ")
        yield line[2:].split("  #")[0].strip()


@pytest.mark.sampled(0)  # the page of the tutorials runs the same commands
def test_from_one_to_another(tmp_path: Path) -> None:
    port = free_port()
    kinds, (begin, script, look, fetch) = zip(*BLOCKS, strict=True)
    assert kinds == ("console", "python", "console", "console")
    admin, ann = Person(tmp_path / "admin", port), Person(tmp_path / "ann", port)
    serve, *sign_in = commands(begin)
    server = subprocess.Popen(
        [*serve.removesuffix("&").split(), "--port", str(port)],
        cwd=admin.home, env=admin.environment, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert server.stdout is not None
        told = server.stdout.readline()
        password = re.match(r"user admin, password (\S+) ", told)
        assert password is not None, told
        assert server.stdout.readline() == f"serving shared at http://127.0.0.1:{port} (Ctrl-C ends it)\n"
        admin.run(
            f"for i in $(seq 600); do (echo > /dev/tcp/127.0.0.1/{port}) 2>&- && break; sleep 0.1; done"
        )
        for command, secret in zip(sign_in, (password[1], "ann's own password"), strict=True):
            admin.run(command, TUPLI_MCAP_URL=f"http://127.0.0.1:{port}", TUPLI_MCAP_PASSWORD=secret)
        (admin.home / "elsewhere").mkdir()
        assert admin.python(script) == "20 episodes on the server\n"
        benchmarks, episodes, publish = (line for line in commands(look))
        listed = admin.run(benchmarks).splitlines()
        uri = listed[1].split()[0].rstrip("…")
        assert "cartpole" in listed[1]
        assert len(admin.run(episodes).splitlines()) > 2
        assert "published" in admin.run(publish.replace("BENCHMARK_ID", uri[:4]))
        login, pull, found = (line.replace("BENCHMARK_ID", uri[:4]) for line in commands(fetch))
        ann.run(login, TUPLI_MCAP_PASSWORD="ann's own password")
        assert ann.run(pull) == "fetched 20 episodes of 1 benchmark into mine\n"
        assert len(ann.run(found).splitlines()) >= 21
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60)
        if server.stdout is not None:
            server.stdout.close()

"""A real nginx for tests, with the shipped configuration: `docs/howto/deploy/nginx.conf.template`."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from string import Template

TEMPLATE = Path(__file__).parents[2] / "docs/howto/deploy/nginx.conf.template"
_MAIN = """
{user}daemon off;
pid {folder}/pid;
error_log {folder}/error.log;
events {{}}
http {{
    include /etc/nginx/mime.types;
    client_body_temp_path {folder}/bodies;
    proxy_temp_path {folder}/proxied;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
{site}
}}
"""


class NoNginxError(Exception):
    """nginx is not installed here."""


def program() -> str:
    """The path of nginx. NoNginxError if it is not installed."""
    found = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
    if found is None:
        raise NoNginxError("nginx is missing: tools/setup-servers installs it")
    return found


def shipped(server: str, exchanged: Mapping[str, str]) -> str:
    """The shipped configuration for a server, with the ports and paths of this machine."""
    text = Template(TEMPLATE.read_text()).safe_substitute(TUPLI_MCAP_SERVER=server)
    for old, new in exchanged.items():
        assert text.count(old) == 1, f"expected {old!r} once in {TEMPLATE.name}"
        text = text.replace(old, new)
    return text


@contextlib.contextmanager
def running(site: str, port: int) -> Iterator[Path]:
    """Runs nginx with a site within the block; yields the directory of its logs and temporary files."""
    with tempfile.TemporaryDirectory(prefix="nginx") as name:
        folder = Path(name)
        folder.chmod(0o755)
        user = "user root;\n" if os.getuid() == 0 else ""  # temporary directories are their owner's
        text = _MAIN.format(user=user, folder=folder, site=site.replace("/var/log/nginx", name))
        (folder / "nginx.conf").write_text(text)
        command = [program(), "-c", str(folder / "nginx.conf"), "-p", name, "-e", str(folder / "error.log")]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while True:
                with contextlib.suppress(OSError):
                    socket.create_connection(("127.0.0.1", port), timeout=5).close()
                    break
                assert process.poll() is None, (folder / "error.log").read_text()
                time.sleep(0.02)
            yield folder
        finally:
            process.terminate()
            process.wait(30)

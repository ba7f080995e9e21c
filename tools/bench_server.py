"""Measures a server: transfers beside nginx, and memory while it streams. Server and clients share this machine.
`bench_questions.py` measures queries.

    python tools/bench_server.py transfers [--mib 1024] [--rounds 3]
    python tools/bench_server.py memory [--mib 256] [--clients 32]

transfers   curl uploads and downloads a recording: with `tupli-mcap serve`, with the same behind nginx in the shipped
            configuration (but without TLS), and with nginx alone (a static file; PUT by its dav module). An upload to
            our server ends when the SHA-256 is checked and the recording is durable and listed; one to nginx when the
            file is written, which is also timed with an fsync.
memory      How much the memory of a server's processes grows while clients slowly fetch whole recordings, and while
            as many users send one each at the same time.

Exits with 1 if a figure misses its limit.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
import nginx
from served import served, sign_in
from waiting import free_port

MIB = 1 << 20
RATE, MEMORY_MIB = 0.6, 150
_DAV = """
    server {{
        listen 127.0.0.1:{port};
        client_max_body_size 0;
        location / {{ root {root}; sendfile on; dav_methods PUT; create_full_put_path on; }}
    }}
"""


def record(path: Path, mib: int, seed: int = 0) -> None:
    """Makes a recording of so many MiB of numbers that do not compress."""
    from gymnasium import spaces

    import tupli_mcap

    box = spaces.Box(-np.inf, np.inf, (1 << 15,), np.float32)
    rng = np.random.default_rng(seed)
    values = rng.integers(1, 1 << 30, (64, 1 << 15), dtype=np.uint32).view(np.float32)
    with tupli_mcap.EpisodeWriter(path, box, spaces.Discrete(2)) as writer:
        for start in range(0, mib * 8, 64):
            writer.begin()
            for i in range(64):
                values[i, :8] = start + i  # no chunk is like another one
                writer.step(values[i], 0, reward=0.0, terminal=i == 63)
            writer.end(values[0])


# --- transfers ---


def curl(*arguments: str) -> float:
    """How long curl takes for a transfer, in seconds."""
    told = "%{http_code} %{time_total}"
    command = ["curl", "-sS", "-o", "/dev/null", "-w", told, "-H", "Expect:", *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    status, seconds = done.stdout.split()
    if status not in ("200", "201", "204"):
        raise SystemExit(f"curl {arguments[-1]} was answered with {status}")
    return float(seconds)


def synced(path: Path) -> float:
    """How long it takes until a file is on the disk, in seconds."""
    begun = time.perf_counter()
    with path.open("rb") as file:
        os.fsync(file.fileno())
    return time.perf_counter() - begun


class UploadTarget:
    """A server to which recordings are sent."""

    def __init__(self, url: str) -> None:
        self.url = url
        with httpx.Client(base_url=url, timeout=600) as client:
            self.token = sign_in(client)
        self._header = f"Authorization: {self.token['Authorization']}"

    def send(self, path: Path, digest: str) -> float:
        with httpx.Client(base_url=self.url, timeout=600, headers=self.token) as client:
            told = base64.b64encode(digest.encode()).decode()
            headers = {"Upload-Length": str(path.stat().st_size), "Upload-Metadata": f"sha256 {told}"}
            place = client.post("/v1/uploads", headers=headers).headers["Location"]
        return curl(
            "-X", "PATCH", "-T", str(path), "-H", "Upload-Offset: 0", "-H", self._header, self.url + place
        )

    def fetch(self) -> float:
        with httpx.Client(base_url=self.url, timeout=600, headers=self.token) as client:
            (listed,) = client.post("/v1/episodes/list", json={"limit": 1}).json()["items"]
            ticket = client.post("/v1/tickets", json={"recording": listed["recording"]}).json()["path"]
        return curl(self.url + ticket)

    def forget(self) -> None:
        """Deletes everything, so that the same bytes can be sent anew."""
        with httpx.Client(base_url=self.url, timeout=600, headers=self.token) as client:
            client.post("/v1/episodes/delete", json={"filter": {"type": "GEQ", "key": "steps", "value": 0}})


def transfers(options: argparse.Namespace, folder: Path) -> bool:
    path = folder / "run.mcap"
    record(path, options.mib)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    size = path.stat().st_size
    static, before = free_port(), free_port()
    root = folder / "static"
    root.mkdir(mode=0o755)
    with (
        served(folder / "served", "--trusted-proxy", "127.0.0.1", "--accel", "/files") as behind,
        contextlib.ExitStack() as stack,
    ):
        direct = stack.enter_context(served(folder / "direct"))
        site = nginx.shipped(
            behind.url.removeprefix("http://"),
            {
                "listen 443 ssl": f"listen 127.0.0.1:{before}",
                "    listen 80;\n": f"    listen 127.0.0.1:{free_port()};\n",
                "    ssl_certificate /etc/nginx/tls/certificate.pem;\n": "",
                "    ssl_certificate_key /etc/nginx/tls/key.pem;\n": "",
                "/srv/tupli-mcap/": f"{folder}/served/",
            },
        )
        site += _DAV.format(port=static, root=root)
        stack.enter_context(nginx.running(site, static))
        ours = {
            "serve": UploadTarget(direct.url),
            "nginx before serve": UploadTarget(f"http://127.0.0.1:{before}"),
        }
        alone = f"http://127.0.0.1:{static}/run.mcap"
        up: dict[str, list[float]] = {name: [] for name in ("nginx", "nginx and fsync", *ours)}
        down: dict[str, list[float]] = {name: [] for name in ("nginx", *ours)}
        for _ in range(options.rounds):
            up["nginx"].append(curl("-T", str(path), alone))
            up["nginx and fsync"].append(up["nginx"][-1] + synced(root / "run.mcap"))
            down["nginx"].append(curl(alone))
            (root / "run.mcap").unlink()
            for name, place in ours.items():
                up[name].append(place.send(path, digest))
                down[name].append(place.fetch())
                place.forget()
    print(
        f"{size / 1e9:.2f} GB, rounds side by side: MB/s, and the ratio to nginx's rate in the same round (median)"
    )
    good = True
    for way, taken in (("up", up), ("down", down)):
        for name, seconds in taken.items():
            ratio = statistics.median(n / s for n, s in zip(taken["nginx"], seconds, strict=True))
            rates = ", ".join(f"{size / 1e6 / each:.0f}" for each in seconds)
            print(f"  {way:5}{name:20}{ratio:6.2f}   {rates}")
            good &= ratio >= RATE or name == "nginx and fsync"
    print(f"must reach: {RATE} (nginx before serve is what is recommended)")
    return good


# --- memory ---


def memory(options: argparse.Namespace, folder: Path) -> bool:
    path = folder / "run.mcap"
    record(path, options.mib)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with served(folder / "served") as server:
        process = psutil.Process(server.pid)
        place = UploadTarget(server.url)
        before = held(process)
        place.send(path, digest)
        sent = held(process)
        with httpx.Client(base_url=server.url, timeout=600, headers=place.token) as client:
            (listed,) = client.post("/v1/episodes/list", json={"limit": 1}).json()["items"]
            ticket = client.post("/v1/tickets", json={"recording": listed["recording"]}).json()["path"]
        whole = most_held(
            process, options.clients, server.port, f"GET {ticket} HTTP/1.1\r\nHost: x\r\n\r\n".encode()
        )
        body = json.dumps({"filter": {"type": "GEQ", "key": "steps", "value": 0}}).encode()
        head = (
            f"Host: x\r\nAuthorization: {place.token['Authorization']}\r\nContent-Type: application/json\r\n"
        )
        query = f"POST /v1/query HTTP/1.1\r\n{head}Content-Length: {len(body)}\r\n\r\n".encode() + body
        cut = most_held(process, options.clients, server.port, query)
    with served(folder / "another") as server:  # what was freed before stays with a process, and would count
        process, token = psutil.Process(server.pid), UploadTarget(server.url).token
        empty = held(process)
        many = most_held_by_uploads(process, options.clients, server.url, token, path, digest)
    print(f"resident MiB: {before:.0f} at first, {sent:.0f} after an upload of {options.mib} MiB")
    print(
        f"  at most {whole:.0f} while {options.clients} clients fetch the recording ({whole - before:+.0f})"
    )
    print(
        f"  at most {cut:.0f} while {options.clients} clients query all of its episodes ({cut - before:+.0f})"
    )
    print(f"  at most {many:.0f} while {options.clients} users send it ({many - empty:+.0f})")
    print(f"must reach: +{MEMORY_MIB}")
    return max(whole - before, cut - before, many - empty) <= MEMORY_MIB


def held(process: psutil.Process) -> float:
    """Resident MiB of a process and its children."""
    return float(sum(each.memory_info().rss for each in (process, *process.children(recursive=True))) / MIB)


def most_held(process: psutil.Process, clients: int, port: int, request: bytes) -> float:
    """The most memory of a server while clients read their answers, 8 MiB at a time in turn."""
    most, open_, waiting = 0.0, [], 0.0
    for _ in range(clients):
        connection = socket.create_connection(("127.0.0.1", port), timeout=120)
        connection.sendall(request)
        open_.append(connection)
    begun = time.monotonic()
    while open_ and time.monotonic() - begun < 60:
        for connection in list(open_):
            connection.settimeout(2)
            taken = 0
            with contextlib.suppress(TimeoutError):
                while taken < 8 * MIB and (piece := connection.recv(MIB)):
                    taken += len(piece)
            waiting += not taken
            if not taken and waiting > clients:
                connection.close()
                open_.remove(connection)
            most = max(most, held(process))
    for connection in open_:
        connection.close()
    return most


def most_held_by_uploads(
    process: psutil.Process, users: int, url: str, admin: dict[str, str], path: Path, digest: str
) -> float:
    """The most memory of a server while users send a recording each, 1 MiB at a time in turn."""
    open_ = []
    told = base64.b64encode(digest.encode()).decode()
    size, port = path.stat().st_size, int(url.rpartition(":")[2])
    announced = {"Upload-Length": str(size), "Upload-Metadata": f"sha256 {told}"}
    with httpx.Client(base_url=url, timeout=600) as client:
        for number in range(users):
            user = {"username": f"user{number}", "password": f"password of user{number}"}
            client.post("/v1/users", json=user, headers=admin)
            token = {"Authorization": f"Bearer {client.post('/v1/tokens', json=user).json()['access_token']}"}
            begun = client.post("/v1/uploads", headers={**token, **announced}).headers["Location"]
            head = f"PATCH {begun} HTTP/1.1\r\nHost: x\r\nUpload-Offset: 0\r\nContent-Length: {size}\r\n"
            connection = socket.create_connection(("127.0.0.1", port), timeout=600)
            connection.sendall(f"{head}Authorization: {token['Authorization']}\r\n\r\n".encode())
            open_.append(connection)
    most = 0.0
    with path.open("rb") as file:
        while piece := file.read(MIB):
            for connection in open_:
                connection.sendall(piece)
            most = max(most, held(process))
    while open_:
        for connection in list(open_):
            connection.settimeout(0.1)
            with contextlib.suppress(TimeoutError):
                answer = connection.recv(MIB)
                if b" 204 " not in answer[:20]:
                    raise SystemExit(f"an upload was answered with {answer[:200]!r}")
                connection.close()
                open_.remove(connection)
            most = max(most, held(process))
    return most


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = {kind.__name__: kind for kind in (transfers, memory)}
    parser.add_argument("kind", choices=kinds)
    parser.add_argument("--mib", type=int, default=1024, help="of a recording")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--clients", type=int, default=32)
    options = parser.parse_args()
    print(f"load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory(prefix="bench") as folder:
        Path(folder).chmod(0o755)
        good = kinds[options.kind](options, Path(folder))
    sys.exit(not good)


if __name__ == "__main__":
    main()

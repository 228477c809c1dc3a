"""The suite's guard: no test, and no Python process that a test starts, reaches another machine."""

import multiprocessing
import os
import socket
import subprocess
import sys
import threading

import pytest
from loopback_only import NetworkBlockedError, is_here

ELSEWHERE = "192.0.2.1"  # for documentation (RFC 5737): nobody is there


def udp(host):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.sendto(b"x", (host, 9))


def tcp(host):
    with socket.socket() as made:
        made.settimeout(1)
        made.connect_ex((host, 9))


def six(host):
    with socket.socket(socket.AF_INET6) as made:
        made.settimeout(1)
        made.connect(("2001:db8::1", 9))


@pytest.mark.parametrize(
    "call",
    [
        udp, tcp, six, lambda host: socket.create_connection((host, 9), 1), lambda host: socket.getaddrinfo(host, 9),
        lambda host: socket.gethostbyname("example.org"),
        lambda host: socket.getaddrinfo("example.org", 443),
    ],
)  # fmt: skip
def test_other_machines_are_refused(call):
    with pytest.raises(NetworkBlockedError, match="may only talk to this machine"):
        call(ELSEWHERE)


def test_an_http_client_is_refused():
    import httpx2

    with pytest.raises(httpx2.ConnectError, match="may only talk to this machine"):
        httpx2.get(f"http://{ELSEWHERE}:9/", timeout=1)


def test_this_machine_answers(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet():
            with server.accept()[0] as made:
                made.sendall(b"hello")

        thread = threading.Thread(target=greet)
        thread.start()
        with socket.create_connection(("localhost", server.getsockname()[1]), 5) as made:
            assert made.recv(5) == b"hello"
        thread.join()
    if hasattr(socket, "AF_UNIX"):
        with socket.socket(socket.AF_UNIX) as server, socket.socket(socket.AF_UNIX) as client:
            server.bind(str(tmp_path / "s"))
            server.listen()
            client.connect(str(tmp_path / "s"))


def test_what_is_here():
    assert all(is_here(host) for host in ("127.0.0.1", "127.9.9.9", "::1", "localhost", "", None, b"localhost"))
    assert not any(is_here(host) for host in (ELSEWHERE, "10.0.0.1", "localhost.example.org", "8.8.8.8", "<broadcast>"))


CODE = f"import socket; socket.create_connection(('{ELSEWHERE}', 9), 1)"


@pytest.mark.slow
def test_processes_that_tests_start_are_refused_too(tmp_path):
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 1
    assert "NetworkBlockedError" in done.stderr
    # and their children, also where a test gives PYTHONPATH something more
    inner = f"import subprocess, sys; sys.exit(subprocess.run([sys.executable, '-c', {CODE!r}]).returncode)"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([os.environ["PYTHONPATH"], str(tmp_path)])}
    done = subprocess.run([sys.executable, "-c", inner], capture_output=True, text=True, env=env)
    assert done.returncode == 1
    assert "NetworkBlockedError" in done.stderr


@pytest.mark.slow
def test_workers_are_refused_too():
    with (
        multiprocessing.get_context("spawn").Pool(1) as pool,
        pytest.raises(OSError, match="only talk to this machine"),
    ):
        pool.apply(udp, (ELSEWHERE,))

"""Refuse connections to anything but this machine: for every Python process of the test suite.

An audit hook sees each connect, datagram and name look-up before it happens, whatever library makes it. What is not
Python (a browser, a server of a library in another language) is not seen.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import sys
from pathlib import Path
from typing import Any

_installed = False


class NetworkBlockedError(OSError):
    """A test tried to reach another machine."""


def is_here(host: Any) -> bool:
    """Return whether a host is this machine: loopback by name or number, the wildcard address, or its own name."""
    if host in (None, "", b"", "localhost", b"localhost", "<broadcast>"):
        return host != "<broadcast>"
    text = host.decode("ascii", "replace") if isinstance(host, bytes) else str(host)
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return text == socket.gethostname()
    return address.is_loopback or address.is_unspecified


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not event.startswith("socket."):
        return
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        made, address = arguments
        if made.family not in (socket.AF_INET, socket.AF_INET6) or not isinstance(address, tuple):
            return
        host = address[0]
    elif event in ("socket.getaddrinfo", "socket.gethostbyname"):
        host = arguments[0]
    else:
        return
    if not is_here(host):
        raise NetworkBlockedError(
            f"{event} to {host!r}: tests may only talk to this machine. Serve it on 127.0.0.1, or fake it."
        )


def install() -> None:
    """Block this process and, through PYTHONPATH, all Python processes that it starts. There is no way back."""
    global _installed
    if _installed:
        return
    _installed = True
    sys.addaudithook(_hook)
    folder = str(Path(__file__).parent)
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    if folder not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([folder, *paths])

"""A small HTTP server on the loopback that misbehaves on request; shared by the download and the fetch tests."""

import contextlib
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Site:
    """What the server holds and how it fails.

    files maps paths to content, moved maps paths to Location headers, answers maps paths to a list of statuses that
    come before the content does. cut_every ends each connection after that many body bytes; corrupt counts down the
    answers whose last byte is flipped; hangs counts down those in the middle of which the server falls silent, or drips
    zeros, until the client leaves.
    """

    files: dict[str, bytes] = field(default_factory=dict)
    moved: dict[str, str] = field(default_factory=dict)
    answers: dict[str, list[int]] = field(default_factory=dict)
    cut_every: int | None = None
    corrupt: int = 0
    hangs: int = 0
    drip: bool = False
    ranges: bool = True
    wrong_range: bool = False
    length: bool = True
    encoding: str | None = None
    seen: list[tuple[str, str | None]] = field(default_factory=list)
    agents: list[dict[str, str]] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)
    url: str = ""


def _handler(site: Site) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = 300

        def log_message(self, *_):
            pass

        def _plain(self, status, **headers):
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name.replace("_", "-"), value)
            self.send_header("Content-Length", "0")
            self.send_header("Connection", "close")
            self.end_headers()

        def do_GET(self):
            site.seen.append((self.path, self.headers.get("Range")))
            site.agents.append(dict(self.headers))
            if self.path in site.moved:
                return self._plain(302, Location=site.moved[self.path])
            if site.answers.get(self.path):
                return self._plain(site.answers[self.path].pop(0), Retry_After="0")
            if self.path not in site.files:
                return self._plain(404)
            data = site.files[self.path]
            if site.corrupt:
                site.corrupt -= 1
                data = data[:-1] + bytes([data[-1] ^ 1])
            start = 0
            wanted = self.headers.get("Range")
            if wanted and site.ranges:
                start = int(wanted.removeprefix("bytes=").rstrip("-"))
                if start >= len(data):
                    return self._plain(416, Content_Range=f"bytes */{len(data)}")
                self.send_response(206)
                start = 0 if site.wrong_range else start
                self.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
            else:
                self.send_response(200)
            if site.length:
                self.send_header("Content-Length", str(len(data) - start))
            if site.encoding:
                self.send_header("Content-Encoding", site.encoding)
            self.send_header("Connection", "close")
            self.end_headers()
            self._body(data[start:])
            return None

        def _body(self, body):
            if site.hangs:
                site.hangs -= 1
                self.wfile.write(body[: len(body) // 2])
                self.wfile.flush()
                while not site.stop.wait(0.02):
                    if site.drip:
                        self.wfile.write(b"\0")
                return
            self.wfile.write(body if site.cut_every is None else body[: site.cut_every])

        def handle(self):
            with contextlib.suppress(ConnectionError, TimeoutError):
                super().handle()

        def finish(self):
            with contextlib.suppress(ConnectionError):
                super().finish()

    return Handler


@contextlib.contextmanager
def serving(site: Site):
    """Serve `site` on a free port of 127.0.0.1; site.url is its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(site))
    server.daemon_threads = True
    site.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield site
    finally:
        site.stop.set()
        server.shutdown()
        server.server_close()
        thread.join(timeout=5)

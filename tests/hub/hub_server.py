"""A small Hugging Face Hub on the loopback, for the real huggingface_hub client, that misbehaves on request.

It speaks what the client asks for while Xet is switched off: create a repository and branches, preupload, git-LFS batch
with basic transfers and verification, commits as ndjson with a parent, info, tree (in pages), resolve with HEAD, GET,
Range and ETag, large files behind a redirect to another host name. It does not speak Xet, multi-part uploads, or
anything that the package does not use.

Run it by hand: ``python tests/hub/hub_server.py`` prints the variables that a shell needs.
"""

import base64
import contextlib
import hashlib
import json
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

TOKEN = "hf_loopback"
LFS_SUFFIXES = (".h5", ".npz", ".safetensors", ".png", ".gif")
PAGE = 7


@dataclass
class Fault:
    """What goes wrong with requests that fit.

    method and path (a pattern searched in the path) choose requests, times how many of them, after how many to leave
    alone. kind: "status" answers `status` with `headers`; "cut" ends the connection after `at` body bytes (of the
    answer, or of the upload); "flip" changes a byte of the answer's body; "stall" is silent for `seconds` or until
    `over` is set, and then cuts the connection; "call" runs `action(hub)` before the request is served.
    """

    kind: str
    path: str = ""
    method: str = ""
    times: int = 1
    after: int = 0
    status: int = 503
    headers: dict[str, str] = field(default_factory=dict)
    at: int = 0
    seconds: float = 0.0
    action: Any = None
    over: threading.Event = field(default_factory=threading.Event, init=False)

    def fits(self, method: str, path: str) -> bool:
        return self.method in ("", method) and re.search(self.path, path) is not None


@dataclass
class Repo:
    private: bool = False
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)

    def commit(self, branch: str, files: dict[str, bytes]) -> str:
        listed = "\n".join(f"{k} {hashlib.sha256(v).hexdigest()}" for k, v in sorted(files.items()))
        oid = hashlib.sha1(f"{len(self.commits)}{branch}{listed}".encode()).hexdigest()
        self.commits[oid] = files
        self.branches[branch] = oid
        return oid

    def find(self, revision: str) -> str | None:
        return self.branches.get(revision) or (revision if revision in self.commits else None)

    def files(self, revision: str = "main") -> dict[str, bytes]:
        return self.commits[self.branches[revision]]


@dataclass
class LoopbackHub:
    """Everything that the server holds, and how it fails."""

    repos: dict[tuple[str, str], Repo] = field(default_factory=dict)
    lfs: dict[str, bytes] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)
    seen: list[tuple[str, str, str | None]] = field(default_factory=list)
    uploads: list[str] = field(default_factory=list)
    # every answer of file content ends its connection after this many bytes
    cut_every: int | None = None
    leaked: list[str] = field(default_factory=list)
    lock: threading.RLock = field(default_factory=threading.RLock)
    url: str = ""
    cdn: str = ""

    def repo(self, name: str, kind: str = "dataset") -> Repo:
        return self.repos[kind, name]

    def count(self, pattern: str, method: str = "") -> int:
        return sum(bool(re.search(pattern, path)) and method in ("", m) for m, path, _ in self.seen)

    def take_fault(self, method: str, path: str) -> Fault | None:
        with self.lock:
            for fault in self.faults:
                if fault.times and fault.fits(method, path):
                    if fault.after:
                        fault.after -= 1
                        continue
                    fault.times -= 1
                    return fault
        return None


def blob_id(data: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def is_lfs(path: str) -> bool:
    return path.endswith(LFS_SUFFIXES)


class _RefusedError(Exception):
    def __init__(self, status: int, code: str = "", message: str = "") -> None:
        self.status, self.code, self.message = status, code, message


class _Handler(BaseHTTPRequestHandler):
    hub: LoopbackHub
    timeout = 300

    def log_message(self, *_: Any) -> None:
        pass

    # ---- plumbing ----

    def handle(self) -> None:
        with contextlib.suppress(ConnectionError, TimeoutError, ValueError):
            super().handle()

    def finish(self) -> None:
        with contextlib.suppress(ConnectionError, ValueError):
            super().finish()

    def _serve(self) -> None:
        hub, method = self.hub, self.command
        split = urlsplit(self.path)
        self.route, self.query = unquote(split.path), parse_qs(split.query)
        with hub.lock:
            hub.seen.append((method, self.route, self.headers.get("Range")))
        self.fault = hub.take_fault(method, self.route)
        if self.fault is not None and self.fault.kind == "call":
            self.fault.action(hub)
        if self.fault is not None and self.fault.kind == "stall":
            self.fault.over.wait(self.fault.seconds)
            self.close_connection = True
            return
        if self.fault is not None and self.fault.kind == "cut" and method in ("PUT", "POST"):
            self.rfile.read(min(self.fault.at, int(self.headers.get("Content-Length", 0))))
            self.connection.close()
            return
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.fault is not None and self.fault.kind == "status":
            self._send(self.fault.status, b"", self.fault.headers)
            return
        try:
            self._route(method)
        except _RefusedError as refused:
            headers = {"X-Error-Code": refused.code, "X-Error-Message": refused.message}
            body = json.dumps({"error": refused.message or refused.code}).encode()
            self._send(refused.status, body, {k: v for k, v in headers.items() if v})

    do_GET = do_HEAD = do_POST = do_PUT = _serve  # noqa: N815

    def _send(
        self, status: int, body: bytes, headers: dict[str, str] | None = None, *, total: int | None = None
    ) -> None:
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body) if total is None else total))
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _json(self, value: Any, headers: dict[str, str] | None = None) -> None:
        self._send(200, json.dumps(value).encode(), {"Content-Type": "application/json", **(headers or {})})

    # ---- routes ----

    def _route(self, method: str) -> None:
        path = self.route
        if path == "/api/validate-yaml":
            return self._json({"errors": [], "warnings": []})
        if path == "/api/whoami-v2":
            return self._json({"type": "user", "name": self._user(), "orgs": []})
        if path == "/api/repos/create":
            return self._create()
        if found := re.fullmatch(r"/cdn/([0-9a-f]{64})", path):
            return self._cdn(found[1])
        if found := re.fullmatch(r"/lfs/([0-9a-f]{64})(/verify)?", path):
            return self._verify(found[1]) if found[2] else self._receive(found[1])
        if found := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            return self._batch("dataset" if found[1] else "model", found[2])
        if found := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            return self._resolve("dataset" if found[1] else "model", *found.groups()[1:])
        if found := re.fullmatch(r"/api/(dataset|model)s/([^/]+/[^/]+)(?:/([a-z-]+)(?:/(.+))?)?", path):
            return self._api(method, *found.groups())
        raise _RefusedError(404, "", f"no such route: {method} {path}")

    def _user(self) -> str:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if token and token != TOKEN:
            raise _RefusedError(401, "", "Invalid credentials in Authorization header")
        if not token:
            raise _RefusedError(401, "", "Unauthorized")
        return "user"

    def _find(self, kind: str, name: str) -> Repo:
        repo = self.hub.repos.get((kind, name))
        if repo is None or (repo.private and self.headers.get("Authorization") != f"Bearer {TOKEN}"):
            raise _RefusedError(404, "RepoNotFound", "Repository not found")
        return repo

    def _commit_of(self, repo: Repo, revision: str) -> str:
        commit = repo.find(revision)
        if commit is None:
            raise _RefusedError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return commit

    def _create(self) -> None:
        self._user()
        asked = json.loads(self.body)
        key = (asked.get("type", "model"), f"{asked['organization']}/{asked['name']}")
        if asked["organization"] != "user":
            raise _RefusedError(403, "", "You do not have the rights to create a repository there")
        url = f"{self.hub.url}/{'datasets/' if key[0] == 'dataset' else ''}{key[1]}"
        with self.hub.lock:
            if key in self.hub.repos:
                return self._send(409, json.dumps({"error": "it exists", "url": url}).encode())
            repo = Repo(private=asked.get("visibility") == "private")
            repo.commit("main", {".gitattributes": b"*.h5 filter=lfs\n"})
            self.hub.repos[key] = repo
        return self._json({"url": url})

    def _api(self, method: str, kind: str, name: str, verb: str | None, rest: str | None) -> None:
        repo = self._find(kind, name)
        if verb in ("preupload", "commit", "branch"):
            self._user()
        if verb == "branch":
            if rest in repo.branches:
                raise _RefusedError(409, "", "Reference already exists")
            repo.branches[str(rest)] = repo.branches["main"]
            return self._json({})
        revision, _, under = (rest or "main").partition("/")
        commit = self._commit_of(repo, revision)
        if verb in (None, "revision"):
            siblings = [{"rfilename": path} for path in repo.commits[commit]]
            return self._json({"id": name, "sha": commit, "private": repo.private, "siblings": siblings, "tags": []})
        if verb == "tree":
            return self._tree(repo.commits[commit], under)
        if verb == "preupload":
            return self._preupload(repo.commits[commit])
        if verb == "commit":
            return self._take_commit(repo, revision, commit, name)
        raise _RefusedError(404, "", f"no such route: {method} {self.route}")

    def _tree(self, files: dict[str, bytes], under: str) -> None:
        names = sorted(path for path in files if path.startswith(under))
        first = int(self.query.get("cursor", ["0"])[0])
        entries = []
        for path in names[first : first + PAGE]:
            data = files[path]
            entry: dict[str, Any] = {"type": "file", "path": path, "size": len(data), "oid": blob_id(data)}
            if is_lfs(path):
                entry["lfs"] = {"oid": hashlib.sha256(data).hexdigest(), "size": len(data), "pointerSize": 130}
            entries.append(entry)
        more = {}
        if first + PAGE < len(names):
            more["Link"] = (
                f'<{self.hub.url}{urlsplit(self.path).path}?recursive=true&cursor={first + PAGE}>; rel="next"'
            )
        self._json(entries, more)

    def _preupload(self, files: dict[str, bytes]) -> None:
        answer = []
        for asked in json.loads(self.body)["files"]:
            path = asked["path"]
            there = files.get(path)
            oid = None
            if there is not None:
                oid = hashlib.sha256(there).hexdigest() if is_lfs(path) else blob_id(there)
            mode = "lfs" if is_lfs(path) else "regular"
            answer.append({"path": path, "uploadMode": mode, "shouldIgnore": False, "oid": oid})
        self._json({"files": answer})

    def _batch(self, kind: str, name: str) -> None:
        self._user()
        self._find(kind, name)
        objects = []
        for asked in json.loads(self.body)["objects"]:
            entry = {"oid": asked["oid"], "size": asked["size"]}
            if asked["oid"] not in self.hub.lfs:
                href = f"{self.hub.url}/lfs/{asked['oid']}"
                entry["actions"] = {"upload": {"href": href}, "verify": {"href": f"{href}/verify"}}
            objects.append(entry)
        self._json({"transfer": "basic", "objects": objects})

    def _receive(self, oid: str) -> None:
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise _RefusedError(400, "", "the content does not have the announced SHA-256")
        with self.hub.lock:
            self.hub.lfs[oid] = self.body
            self.hub.uploads.append(oid)
        self._send(200, b"")

    def _verify(self, oid: str) -> None:
        if len(self.hub.lfs.get(oid, b"")) != json.loads(self.body)["size"]:
            raise _RefusedError(404, "", "not uploaded")
        self._json({})

    def _take_commit(self, repo: Repo, branch: str, head: str, name: str) -> None:
        lines = [json.loads(line) for line in self.body.splitlines()]
        header = next(line["value"] for line in lines if line["key"] == "header")
        with self.hub.lock:
            head = repo.branches[branch]
            if header.get("parentCommit", head) != head:
                raise _RefusedError(412, "", "A commit has happened since. Please refresh and try again.")
            files = dict(repo.commits[head])
            for line in lines:
                value = line["value"]
                if line["key"] == "file":
                    files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    if value["oid"] not in self.hub.lfs:
                        raise _RefusedError(400, "", f"{value['path']} was not uploaded")
                    files[value["path"]] = self.hub.lfs[value["oid"]]
                elif line["key"] == "deletedFile":
                    del files[value["path"]]
            oid = repo.commit(branch, files)
        self._json({"commitUrl": f"{self.hub.url}/{name}/commit/{oid}", "commitOid": oid, "hookOutput": ""})

    # ---- content ----

    def _resolve(self, kind: str, name: str, revision: str, path: str) -> None:
        repo = self._find(kind, name)
        commit = self._commit_of(repo, revision)
        files = repo.commits[commit]
        if path not in files:
            raise _RefusedError(404, "EntryNotFound", "Entry not found")
        data = files[path]
        headers = {"X-Repo-Commit": commit}
        if not is_lfs(path):
            return self._content(data, {**headers, "ETag": f'"{blob_id(data)}"'})
        oid = hashlib.sha256(data).hexdigest()
        headers |= {
            "X-Linked-ETag": f'"{oid}"',
            "X-Linked-Size": str(len(data)),
            "Location": f"{self.hub.cdn}/cdn/{oid}",
        }
        self.hub.lfs.setdefault(oid, data)
        return self._send(302, b"", headers)

    def _cdn(self, oid: str) -> None:
        if "Authorization" in self.headers:
            self.hub.leaked.append(self.path)
        return self._content(self.hub.lfs[oid], {"ETag": f'"{oid}"'})

    def _content(self, data: bytes, headers: dict[str, str]) -> None:
        start, status = 0, 200
        wanted = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        if wanted:
            start, status = int(wanted[1]), 206
            headers = {**headers, "Content-Range": f"bytes {start}-{len(data) - 1}/{len(data)}"}
        fault = self.fault
        if fault is not None and fault.kind == "flip":
            data = data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :]
        body = data[start:]
        stop = self.hub.cut_every
        if fault is not None and fault.kind == "cut":
            stop = fault.at
        self._send(
            status,
            body if stop is None else body[:stop],
            {"Accept-Ranges": "bytes", **headers},
            total=len(body),
        )


@contextlib.contextmanager
def serving(hub: LoopbackHub | None = None, port: int = 0) -> Iterator[LoopbackHub]:
    """Serve `hub` on 127.0.0.1; hub.url is its address, hub.cdn the host name that large files come from."""
    hub = hub or LoopbackHub()
    handler = type("Handler", (_Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", port), handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    hub.cdn = f"http://localhost:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        for fault in hub.faults:
            fault.over.set()
        server.shutdown()
        server.server_close()
        thread.join(timeout=5)


if __name__ == "__main__":
    with serving() as running:
        print(f"export HF_ENDPOINT={running.url} HF_TOKEN={TOKEN} HF_HUB_DISABLE_XET=1", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600)

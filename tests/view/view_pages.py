"""Results files as a benchmark writes them, and pages read back with the standard library and numpy alone."""

from __future__ import annotations

import base64
import json
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

HOSTILE = "</script><img src=x onerror=alert(1)><!--<script>&amp;\u2028'\""


def write_results(folder: Path, name: str, *, n: int = 60, scenarios: int = 3, seed: int = 0, **settings: str) -> Path:
    """Write a results file as `navrep-data benchmark` does."""
    rng = np.random.default_rng(seed)
    events = [str(e) for e in rng.choice(["goal", "collision_human", "collision_obstacle", "timeout"], n)]
    letters = {"goal": "S", "timeout": "T"}
    steps = rng.integers(5, 100, n)
    columns = {
        "seed": [1000 + k for k in range(n)],
        "scenario": [f"place {k % scenarios}" for k in range(n)] if scenarios > 1 else [],
        "event": events,
        "steps": steps.tolist(),
        "path_length": rng.uniform(1, 20, n).round(5).tolist(),
        "contacts_human": [int(e == "collision_human" or k % 5 == 0) for k, e in enumerate(events)],
        "contacts_obstacle": [int(e == "collision_obstacle") for e in events],
        "contact_speed": [0.5 if e.startswith("collision") or k % 5 == 0 else None for k, e in enumerate(events)],
        "time_to_goal": [float(s) if e == "goal" else None for s, e in zip(steps, events, strict=True)],
    }
    paths = {
        str(k): np.cumsum(rng.integers(-50, 60, (min(int(steps[k]), 60), 2)), axis=0).ravel().tolist()
        for k in range(n - 5)
    }
    value = {
        "format": "navrep-data-benchmark", "version": 2, "name": name, "sees": "scan", "variant": "",
        "settings": {"suite": "navrep27", "physics": "original", "inference": "deterministic", "first_round": 0}
        | settings,
        "versions": {}, "outcome": "".join(letters.get(e, "C") for e in events), "episodes": columns,
        "trajectories_cm": paths,
    }  # fmt: skip
    folder.mkdir(exist_ok=True)
    file = folder / f"{seed}.json"
    file.write_text(json.dumps(value))
    return file


class Reader(HTMLParser):
    """Elements in order, and the text of scripts and styles."""

    def __init__(self, html: bytes) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.scripts: list[tuple[dict, str]] = []
        self.styles: list[str] = []
        self.policy = ""
        self._inside = ""
        self.feed(html.decode())
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self._inside = tag
        named = dict(attrs)
        if tag == "script":
            self.scripts.append((named, ""))
        if tag == "style":
            self.styles.append("")
        if named.get("http-equiv") == "Content-Security-Policy":
            self.policy = named["content"]

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] = (self.scripts[-1][0], self.scripts[-1][1] + data)
        if self._inside == "style":
            self.styles[-1] += data

    def handle_endtag(self, tag):
        self._inside = ""

    def block(self, name):
        return next(text for attributes, text in self.scripts if attributes.get("id") == name)

    @property
    def meta(self):
        return json.loads(self.block("meta"))

    def arrays(self, entry):
        """Decode the arrays of a stream, number by number."""
        data = zlib.decompress(base64.b64decode(self.block(f"blob-{entry['blob']}")), wbits=-15)
        assert len(data) == entry["size"]
        found = {}
        for name, a in entry["arrays"].items():
            count = int(np.prod(a["shape"]))
            if a["type"] == "u8":
                found[name] = np.frombuffer(data, np.uint8, count, a["at"]).reshape(a["shape"])
                continue
            low = np.frombuffer(data, np.uint8, count, a["at"]).astype(np.int64)
            folded = low + 256 * np.frombuffer(data, np.uint8, count, a["at"] + count).astype(np.int64)
            difference = np.where(folded % 2, -(folded + 1) // 2, folded // 2).reshape(a["shape"])
            codes = np.cumsum(difference, axis=-1) % 65536
            found[name] = np.where(codes == 65535, np.nan, a["origin"] + a["step"] * codes)
        return found

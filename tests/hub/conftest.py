"""A Hub on the loopback, and huggingface_hub pointed at it."""

import time
import types
from pathlib import Path
from urllib.parse import unquote

import huggingface_hub
import pytest
from hub_server import TOKEN, LoopbackHub, serving
from huggingface_hub import constants, file_download
from huggingface_hub.utils import _http
from shards.synthetic import make_dataset

from navrep_data.datasets import _hub_extras
from navrep_data.hub import client


@pytest.fixture
def quick(monkeypatch):
    """Waiting costs no time; returns the pauses that were asked for [s].

    An answer may be as late as a busy machine makes it: one that was given up would be asked for again, and tests count
    requests. What stalls on purpose is noticed soon with `impatient`.
    """
    pauses: list[float] = []
    clock = types.SimpleNamespace(**{name: getattr(time, name) for name in ("time", "monotonic", "perf_counter")})
    clock.sleep = pauses.append
    for module in (client, _http, file_download):
        monkeypatch.setattr(module, "time", clock)
    for module, name in (
        (client, "SILENCE"), (constants, "HF_HUB_DOWNLOAD_TIMEOUT"), (constants, "HF_HUB_ETAG_TIMEOUT"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, 60.0)
    return pauses


@pytest.fixture
def hub(monkeypatch, tmp_path, quick):
    """The Hub; Xet is switched off, as the loopback does not speak it."""
    for name in ("HF_TOKEN", "HF_HUB_OFFLINE", "NAVREP_DATA_OFFLINE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "navrep-home"))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hf-cache"))
    huggingface_hub.close_session()
    with serving(LoopbackHub()) as running:
        monkeypatch.setattr(constants, "ENDPOINT", running.url)
        monkeypatch.setattr(
            constants, "HUGGINGFACE_CO_URL_TEMPLATE", running.url + "/{repo_id}/resolve/{revision}/{filename}"
        )
        yield running
    huggingface_hub.close_session()
    assert running.leaked == [], "the token went to another host"


@pytest.fixture
def impatient(hub, monkeypatch, request):
    """Silence is noticed soon, 2 s or the parameter [s], of a request that is going to stall and of no other."""
    seconds = getattr(request, "param", 2.0)
    bound = client._bound

    def shorter(asked):
        bound(asked)
        method, path = asked.method, unquote(asked.url.path)
        if any(fault.kind == "stall" and fault.times and fault.fits(method, path) for fault in hub.faults):
            limits = asked.extensions["timeout"]
            asked.extensions["timeout"] = {**limits, "read": min(limits["read"], seconds)}

    monkeypatch.setattr(client, "_bound", shorter)


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes seconds; most tests are about other files."""
    monkeypatch.setattr(_hub_extras, "draw_pictures", lambda folder: {})


@pytest.fixture(scope="session")
def template(tmp_path_factory) -> Path:
    """Six sequences in three shards, which no test may change."""
    root = tmp_path_factory.mktemp("hub") / "soadrl"
    make_dataset(root, 4, 2, 60, by_rule=True)
    return root

"""A Hub on the loopback, and huggingface_hub pointed at it."""

import time
import types
from pathlib import Path

import huggingface_hub
import pytest
from hub_server import TOKEN, LoopbackHub, serving
from huggingface_hub import constants, file_download
from huggingface_hub.utils import _http
from shards.synthetic import make_dataset

from navrep_data.datasets import _hub_client, _hub_extras


@pytest.fixture
def quick(monkeypatch):
    """Waiting costs no time, and silence is noticed soon; returns the pauses that were asked for [s]."""
    pauses: list[float] = []
    clock = types.SimpleNamespace(**{name: getattr(time, name) for name in ("time", "monotonic", "perf_counter")})
    clock.sleep = pauses.append
    for module in (_hub_client, _http, file_download):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(_hub_client, "SILENCE", 0.5)
    monkeypatch.setattr(constants, "HF_HUB_DOWNLOAD_TIMEOUT", 0.5)
    monkeypatch.setattr(constants, "HF_HUB_ETAG_TIMEOUT", 0.5)
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
def no_pictures(monkeypatch):
    """Drawing takes seconds; most tests are about other files."""
    monkeypatch.setattr(_hub_extras, "draw_pictures", lambda folder: {})


@pytest.fixture(scope="session")
def template(tmp_path_factory) -> Path:
    """Six sequences in three shards, which no test may change."""
    root = tmp_path_factory.mktemp("hub") / "soadrl"
    make_dataset(root, 6, 2, 40)
    return root

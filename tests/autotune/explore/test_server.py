"""The server without a visitor."""

import os
import signal
import socket
import threading
from collections.abc import Callable
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from autotune.errors import UsageError
from autotune.explore.saving import SaveInterruptedError, Target
from autotune.explore.server import LOOPBACK, serve
from autotune.formats.controller_record import Controller
from tests.autotune.explore.start import small_exploration
from tests.autotune.tuning.cases import small_controller


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    def ready(address: str) -> None:
        pytest.fail(f"served at {address}")

    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=rf"Port {port} cannot be used: .*; name another one with --port\."):
            serve(small_exploration(), Target(tmp_path / "controller.yaml"), port=port, ready=ready)


def test_an_interrupt_gives_up_a_save_and_does_not_wait_for_it(tmp_path: Path) -> None:
    target = Target(tmp_path / "controller.yaml")
    target.path.write_text("as it was", encoding="utf-8")
    begun, released, raised = threading.Event(), threading.Event(), []

    def make(_progress: Callable[[float], None]) -> Controller:
        begun.set()
        assert released.wait(60.0)
        return small_controller()

    def save() -> None:
        with pytest.raises(SaveInterruptedError) as caught:
            target.save(make)
        raised.append(caught.value)

    saving = threading.Thread(target=save)

    def ready(_address: str) -> None:
        saving.start()
        assert begun.wait(60.0)
        os.kill(os.getpid(), signal.SIGINT)

    serve(small_exploration(), target, port=0, ready=ready)
    assert saving.is_alive()
    assert target.is_cut_short
    released.set()
    saving.join(60.0)
    assert len(raised) == 1
    assert target.path.read_text(encoding="utf-8") == "as it was"


def test_every_answer_forbids_frames_and_foreign_sources(tmp_path: Path) -> None:
    found: dict[str, tuple[int, dict[str, str]]] = {}

    def ask(address: str) -> None:
        page = urlsplit(address)
        asked = {page.path: {}, "/guess/": {}, f"{page.path}static/js/bokeh.min.js": {}, "/": {"Host": "evil.example"}}
        for path, headers in asked.items():
            connection = HTTPConnection(LOOPBACK, page.port, timeout=30)
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            found[path.removeprefix(page.path) if path != "/" else path] = answer.status, dict(answer.getheaders())
            answer.read()
            connection.close()
        os.kill(os.getpid(), signal.SIGINT)

    def ready(address: str) -> None:
        threading.Thread(target=ask, args=(address,)).start()

    serve(small_exploration(), Target(tmp_path / "controller.yaml"), port=0, ready=ready)
    assert {path: status for path, (status, _) in found.items()} == {
        "": 200,
        "/guess/": 404,
        "static/js/bokeh.min.js": 200,
        "/": 403,
    }
    for _, headers in found.values():
        policy = dict(each.split(" ", 1) for each in headers["Content-Security-Policy"].split("; "))
        assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
        assert policy["connect-src"] == "'self'"
        assert headers["X-Frame-Options"] == "DENY"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["Cross-Origin-Resource-Policy"] == headers["Cross-Origin-Opener-Policy"] == "same-origin"

"""Fixtures of the tool's tests."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.autotune.browser import chromium
from tests.autotune.own_process import FORKED, stop_server
from tests.autotune.postgresql import Server, running_server
from tests.autotune.tuning.cases import share_results


@pytest.fixture(scope="session", autouse=True)
def _no_server_left() -> Iterator[None]:
    yield
    stop_server()


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the workers of a pool be forked; tests/autotune/test_processes.py starts them as a user's are."""
    monkeypatch.setattr("autotune.processes.get_context", lambda _method: FORKED)


@pytest.fixture
def unchecked_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the samples be exported, which claim what their law does not hold, where only the form of a file matters."""
    monkeypatch.setattr("autotune.export.export.check_law", lambda *_: None)


@pytest.fixture
def shared_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search, prove and check the same once, where much is done to nearly the same controllers."""
    share_results(monkeypatch)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A real browser without a window; no longer than a module, since its event loop runs in this thread."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tools:
        opened = tools.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def postgresql() -> Iterator[Server]:
    """A server from Debian's packages; each test makes a database of its own."""
    with running_server() as server:
        yield server

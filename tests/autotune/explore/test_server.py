"""The server without a visitor."""

import socket
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.explore.door import LOOPBACK
from autotune.explore.server import serve
from autotune.explore.target import Target
from tests.autotune.explore.start import small_exploration


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    def ready(address: str) -> None:
        pytest.fail(f"served at {address}")

    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=rf"Port {port} cannot be used: .*; name another one with --port\."):
            serve(small_exploration(), Target(tmp_path / "controller.yaml"), port=port, ready=ready)

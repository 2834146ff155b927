"""A study on Redis: a journal that another connection goes on with."""

import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.studies.study import open_storage, run_study
from tests.autotune.studies.small import START, small_plan, small_problem


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def redis_url(tmp_path: Path) -> Iterator[str]:
    """A server of its own that keeps nothing on disk, from Debian's package; yields the URL of its first database."""
    redis = pytest.importorskip("redis")
    if shutil.which("redis-server") is None:
        pytest.skip("needs redis-server")
    port = free_port()
    quiet = ["--bind", "127.0.0.1", "--port", str(port), "--save", "", "--appendonly", "no", "--dir", str(tmp_path)]
    with subprocess.Popen(["redis-server", *quiet], stdout=subprocess.DEVNULL) as server:
        try:
            client, end = redis.Redis(port=port), time.monotonic() + 20.0
            while True:
                try:
                    client.ping()
                    break
                except redis.exceptions.ConnectionError:
                    assert server.poll() is None
                    assert time.monotonic() < end
                    time.sleep(0.05)
            client.close()
            yield f"redis://127.0.0.1:{port}/0"
        finally:
            server.terminate()


def test_a_study_on_redis_goes_on_from_another_connection(redis_url: str, tmp_path: Path) -> None:
    seen = []
    for trials in (3, 5):
        storage = open_storage(redis_url, tmp_path / "unused.db")
        front = run_study(small_problem(), small_plan(trials), storage, start=START, name="shared")
        assert front.study is not None
        seen.append(front.study.trials)
    assert seen == [3, 5]
    assert not (tmp_path / "unused.db").exists()


def test_a_server_that_does_not_answer_is_named(tmp_path: Path) -> None:
    pytest.importorskip("redis")
    url = f"redis://user:secret@127.0.0.1:{free_port()}/0"
    with pytest.raises(UsageError, match=r"redis://user:\*\*\*@127\.0\.0\.1.* cannot be used") as refused:
        open_storage(url, tmp_path / "unused.db")
    assert "secret" not in str(refused.value)

"""A real PostgreSQL server for tests, that can be stopped and started again."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text


@dataclass(frozen=True)
class Server:
    """A server of its own on a socket in a folder; `user` are the words that run a command as its account."""

    folder: Path
    user: tuple[str, ...]

    def run(self, *command: str) -> None:
        """Run one of PostgreSQL's tools."""
        subprocess.run([*self.user, *command], check=True, stdout=subprocess.DEVNULL, cwd=self.folder)

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-k {self.folder} -h ''"
        self.run(
            "pg_ctl", "-D", str(self.folder / "data"), "-w", "-l", str(self.folder / "log"), "-o", options, "start"
        )

    def stop(self) -> None:
        """Stop it at once, as a power failure would."""
        self.run("pg_ctl", "-D", str(self.folder / "data"), "-m", "immediate", "stop")

    def new_database(self, name: str) -> str:
        """Return the URL of a new database; another test leaves its studies in another one."""
        url = f"postgresql+psycopg://tester@/{{}}?host={self.folder}"
        engine = create_engine(url.format("postgres"), isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.execute(text(f"create database {name}"))
        engine.dispose()
        return url.format(name)


@contextmanager
def running_server() -> Iterator[Server]:
    """Start a server from Debian's packages."""
    if shutil.which("initdb") is None or shutil.which("pg_ctl") is None:
        pytest.skip("needs PostgreSQL's initdb and pg_ctl")
    # Not one of pytest's folders: the server refuses to run as root, and no other account may enter those.
    folder = Path(tempfile.mkdtemp(prefix="autotune-pg-"))
    is_root = os.geteuid() == 0
    if is_root:
        shutil.chown(folder, "postgres")  # the account that Debian's package makes
    server = Server(folder, ("runuser", "-u", "postgres", "--") if is_root else ())
    server.run("initdb", "-D", str(folder / "data"), "-U", "tester", "--auth=trust", "--no-sync")
    rules = folder / "data" / "pg_hba.conf"
    rules.write_text("local all guarded scram-sha-256\n" + rules.read_text(encoding="utf-8"), encoding="utf-8")
    server.start()
    try:
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder)

"""A PostgreSQL server of the tests' own: in a folder of its own, at a socket in it, without durability."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from itertools import count
from pathlib import Path

import psutil
import pytest

USERS = ("postgres", "nobody")  # in place of root, as whom it refuses to run
READY_S = 60.0


def programs() -> Path | None:
    """The folder of the server's programs, the newest of several."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"), key=lambda path: int(path.parts[4]))
    if found:
        return found[-1].parent
    path = shutil.which("postgres")
    return None if path is None else Path(path).resolve().parent


class PostgresServer:
    """Runs from `start` to `stop`, which may be repeated; `close` removes it."""

    def __init__(self) -> None:
        folder = programs()
        if folder is None:
            pytest.skip(
                "PostgreSQL is not installed: `apt-get install postgresql`, or `./run test --all` does it"
            )
        pytest.importorskip("psycopg", reason="psycopg is missing: pip install 'deltalight[postgres]'")
        self._programs = folder
        self._folder = Path(tempfile.mkdtemp(prefix="deltalight-pg-", dir="/tmp"))
        self._as_user = ["setpriv", "--pdeathsig", "INT"]
        if os.geteuid() == 0:
            user = next(pwd.getpwnam(name) for name in USERS if _is_user(name))
            os.chown(self._folder, user.pw_uid, user.pw_gid)
            self._as_user += [f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"]
        self._numbers = count()
        self._process: subprocess.Popen[bytes] | None = None
        init = ["initdb", "-D", "data", "-A", "trust", "-U", "deltalight", "-E", "UTF8", "--locale=C", "-N"]
        subprocess.run(self._command(*init), cwd=self._folder, check=True, capture_output=True)

    def start(self) -> None:
        options = (
            "listen_addresses=",
            f"unix_socket_directories={self._folder}",
            "fsync=off",
            "shared_buffers=16MB",
        )
        words = [word for option in options for word in ("-c", option)]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                self._command("postgres", "-D", "data", *words), cwd=self._folder, stdout=log, stderr=log
            )
        deadline_s = time.monotonic() + READY_S
        while self._ask("SELECT 1").returncode != 0:
            assert time.monotonic() < deadline_s, (self._folder / "log").read_text()
            time.sleep(0.05)

    def hang(self) -> None:
        """Keeps all connections and says nothing, until `go_on` or `stop`."""
        for process in self._processes():
            process.suspend()

    def go_on(self) -> None:
        for process in self._processes():
            process.resume()

    def _processes(self) -> list[psutil.Process]:
        """The one that accepts connections first, so that no other begins meanwhile."""
        if self._process is None:
            return []
        first = psutil.Process(self._process.pid)
        return [first, *first.children()]

    def stop(self, *, at_once: bool = False) -> None:
        """Cuts all connections; `at_once` like a power cut, so that it recovers from its log at the next start."""
        self.go_on()
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(signal.SIGQUIT if at_once else signal.SIGINT)
            process.wait(timeout=30)

    def close(self) -> None:
        self.stop(at_once=True)
        shutil.rmtree(self._folder)

    def fresh_database(self) -> str:
        """The address of a new, empty database."""
        name = f"store{next(self._numbers)}"
        made = self._ask(f"CREATE DATABASE {name} TEMPLATE template0")
        assert made.returncode == 0, made.stderr
        return f"postgresql://deltalight@/{name}?host={self._folder}"

    def _ask(self, statement: str) -> subprocess.CompletedProcess[bytes]:
        words = ("psql", "-h", self._folder, "-U", "deltalight", "-d", "postgres", "-qc", statement)
        return subprocess.run(
            [str(self._programs / words[0]), *map(str, words[1:])], check=False, capture_output=True
        )

    def _command(self, program: str, *words: str) -> list[str]:
        return [*self._as_user, str(self._programs / program), *words]


def _is_user(name: str) -> bool:
    try:
        pwd.getpwnam(name)
    except KeyError:
        return False
    return True

"""A private PostgreSQL server for tests, where Debian's package or the PATH has its programs."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def programs() -> Path | None:
    """Where the server's programs are; None without them (scripts/install-postgres.sh brings them)."""
    found = shutil.which("postgres")
    if found is not None:
        return Path(found).resolve().parent
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
    return installed[-1].parent if installed else None


@contextmanager
def private_server() -> Iterator[str | None]:
    """Start a server on a socket in a temporary folder; gives the URL, or None where there is no server.

    PostgreSQL refuses to run as root: then the account that its package made runs it.
    """
    where = programs()
    if where is None:
        yield None
        return
    folder = Path("/tmp") / f"sb3_tbc_postgres_{os.getpid()}"  # a socket's path must be short
    folder.mkdir(mode=0o777)
    prefix: list[str] = []
    if os.getuid() == 0:
        account = pwd.getpwnam("postgres")
        os.chown(folder, account.pw_uid, account.pw_gid)
        prefix = ["runuser", "-u", "postgres", "--"]

    def run(program: str, *arguments: str) -> None:
        line = [*prefix, str(where / program), *arguments]
        subprocess.run(line, check=True, stdout=subprocess.DEVNULL, cwd="/tmp", timeout=120)

    data = str(folder / "data")
    try:
        run("initdb", "-D", data, "-U", "tuner", "--auth=trust", "--no-sync", "-E", "UTF8")
        options = f"-k {folder} -c listen_addresses='' -c fsync=off"
        run("pg_ctl", "-D", data, "-w", "-l", str(folder / "log"), "-o", options, "start")
        try:
            run("createdb", "-h", str(folder), "-U", "tuner", "studies")
            yield f"postgresql+psycopg://tuner@/studies?host={folder}"
        finally:
            run("pg_ctl", "-D", data, "-w", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)

"""Atomic writing: no crash, full disk or power cut leaves half a file, and no reader sees one."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError, FolderInUseError, WriteError

try:
    import fcntl
except ImportError:  # Windows has no such locks: there, two runs in one folder are not noticed
    fcntl = None  # type: ignore[assignment]

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
TEMPORARY = (".tmp*-*", ".*.tmp", "*.partial")
"""Names of files that a killed process leaves behind; the second and third are those of earlier versions."""
LOCK = ".lock"


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on the disk.

    Of a folder, only trouble of the disk itself is an error: Windows cannot open folders, some file systems not sync
    them.
    """
    folder = path.is_dir()
    try:
        handle = os.open(path, os.O_RDONLY if folder else os.O_RDWR)  # Windows syncs only what may be written
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if not folder or error.errno in (errno.EIO, *FULL):
            raise


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn any error of a write within the block into a :class:`.WriteError` about ``path``.

    :param path: what is written
    :raises WriteError: naming the path, the reason and the likely cure
    """
    try:
        yield
    except (WriteError, ConfigError):
        raise
    except Exception as error:
        failure = _system_error(error)
        if failure is None:
            raise
        raise WriteError(f"cannot write {path}: {_reason(failure)}") from error


def _system_error(error: BaseException | None) -> OSError | None:
    """The operating system's error that caused one of torch or NumPy; None if there is none."""
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error
        error = error.__cause__ or error.__context__
    return None


def _reason(error: OSError) -> str:
    reason = error.strerror or type(error).__name__
    if error.errno in FULL:
        return f"{reason}; make room, then go on"
    if isinstance(error, FileExistsError | NotADirectoryError):
        place = Path(str(error.filename))
        in_the_way = next((path for path in (place, *place.parents) if os.path.isfile(path)), place)
        return f"{reason}: {in_the_way} is a file where a folder is needed"
    return f"{reason}; is the folder yours and writable?"


def temporary_beside(path: Path) -> Path:
    """A name for the file that is to replace ``path``, which no other thread, process or machine uses."""
    return path.with_name(f".tmp{os.getpid()}{secrets.token_hex(4)}-{path.name}")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; the file written there replaces ``path`` if the block ends without error.

    The content is on the disk before the file gets its name, and the name is on the disk when the block is left. Of a
    symbolic link, the file that it leads to is replaced.

    :raises WriteError: if the file cannot be written; what was at ``path`` is then untouched
    """
    with explained(path):
        path = Path(os.path.realpath(path)) if path.is_symlink() else path
        _require_file(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_beside(path)
        try:
            yield temporary
            sync(temporary)
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync(path.parent)


def require_writable(path: Path) -> None:
    """Refuse a file that cannot be written, before the minutes of work that it is to hold. Nothing is made.

    :raises WriteError: if it is a folder, or there is no folder for it and none can be made
    """
    with explained(path):
        _require_file(path)
        folder = next(parent for parent in Path(os.path.realpath(path)).parents if parent.exists())
        if not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))


def _require_file(path: Path) -> None:
    if path.is_dir():
        raise WriteError(f"cannot write {path}: it is a folder; name a file, e.g. one in it")
    if path.exists() and not path.is_file():  # a new file takes its place, also that of /dev/null
        raise WriteError(f"cannot write {path}: it is a device or a pipe, which a file would replace; name a file")


def write_atomic(path: Path, text: str) -> None:
    """Write a text file atomically; characters that UTF-8 cannot encode are escaped.

    :raises WriteError: if it cannot be written
    """
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode("utf-8", errors="backslashreplace"))


def save_atomic(save: Callable[[str], object], path: Path) -> None:
    """Let ``save`` write to a temporary file with the same suffix, then put that in place of ``path``.

    :raises WriteError: if it cannot be written
    """
    with replacing(path) as temporary:
        save(str(temporary))


def write_arrays(path: str | Path | io.BufferedIOBase, arrays: PlainMapping) -> None:
    """Write plain arrays to one file. A path is written atomically, and its folder is made if it is missing.

    :raises WriteError: if it cannot be written
    """
    content: Plain = dict(arrays)
    if not isinstance(path, (str, Path)):
        np.savez(path, **content)
        return
    with replacing(Path(path)) as temporary, open(temporary, "wb") as file:
        np.savez(file, **content)


def digest(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal text."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            total.update(block)
    return total.hexdigest()


def remove(path: Path) -> None:
    """Remove a file or a folder with all that is in it, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_temporary(folder: Path) -> None:
    """Remove what killed processes left half written in a folder."""
    for pattern in TEMPORARY:
        for path in folder.glob(pattern):
            remove(path)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder for this process; the folder is made if it is missing.

    The lock ends with the process, however the process ends, so no stale lock is left behind.

    :raises FolderInUseError: if another process holds it
    :raises WriteError: if the folder cannot be made or written to
    """
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        handle = _take(folder / LOCK)
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        os.close(handle)


def in_use(folder: Path) -> bool:
    """Whether a process holds the lock of a folder."""
    try:
        handle = os.open(folder / LOCK, os.O_RDWR)
    except OSError:
        return False
    try:
        _lock(handle, folder / LOCK)
    except FolderInUseError:
        return True
    finally:
        os.close(handle)
    return False


def remove_stale_lock(folder: Path) -> None:
    """Remove the lock's file if its holder was killed; where nobody may write, or somebody holds it, it stays."""
    if (folder / LOCK).exists():
        with contextlib.suppress(FolderInUseError, WriteError), locked(folder):
            pass


def _take(path: Path) -> int:
    """A handle that holds the lock. If the former holder removed the file in the meantime, the next one is tried."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(handle, path)
            if _same_file(handle, path):
                os.truncate(handle, 0)
                os.write(handle, f"{os.getpid()}\n".encode())
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int, path: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        holder = os.read(handle, 32).decode(errors="replace").strip() or "unknown"
        raise FolderInUseError(
            f"{path.parent} is in use by process {holder}; wait until it ends, or use another --variant or --log-folder"
        ) from error
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):  # file systems without locks
            raise


def _same_file(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False

"""Names, numbers and URLs that come from outside: the functions that check them, or make them safe to show."""

from __future__ import annotations

import math
import re

from sb3_tbc.arrays import is_finite
from sb3_tbc.errors import ConfigError

MAX_NAME = 150
"""Longest name of a folder, in bytes; file systems allow 255, and files in it get suffixes."""
SECRET = re.compile(r"((?:pass\w*|pwd|secret|token|key)\s*(?:=|%3d|:))[^&]*", re.IGNORECASE)
HIDDEN = "***"
DEVICES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE | re.DOTALL)
"""Names that Windows keeps for devices, in either case and with any suffix."""


def folder_name(text: str, what: str) -> str:
    """Check that a text can be the name of one folder and return it; slashes and dots must not lead elsewhere.

    :param text: the name
    :param what: what it names, for messages
    :raises ConfigError: if some system does not allow it as a folder's name; the message says what is allowed
    """
    if not isinstance(text, str):
        raise ConfigError(f"{what} must be a text, got {text!r}; put quotes around it in YAML")
    bad = [c for c in text if c in '/\\:*?"<>|' or not c.isprintable() or "\ud800" <= c <= "\udfff"]
    if bad or not text or text.startswith((".", "-", " ")) or text.endswith((".", " ")):
        raise ConfigError(
            f"{what} must be a name for a folder: letters, digits, and - _ . = + inside; got {text!r}"
            + (f" with {bad[0]!r}" if bad else "")
        )
    if DEVICES.fullmatch(text):
        raise ConfigError(f"{what} must not be a name that Windows keeps for a device, as con or com1; got {text!r}")
    if len(text.encode()) > MAX_NAME:
        raise ConfigError(f"{what} must be at most {MAX_NAME} bytes long, got {len(text.encode())}")
    return text


def flat_name(text: str, what: str) -> str:
    """An environment id or task as the name of a folder: its slashes and colons become underscores.

    :raises ConfigError: if it is not a folder's name even then
    """
    return folder_name(text.replace("/", "_").replace(":", "_") if isinstance(text, str) else text, what)


def number(value: object, what: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Check that a value is a finite number within bounds; text and truth values are refused.

    :param value: as JSON or YAML gave it
    :param what: what it is, for messages
    :raises ConfigError: otherwise
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not is_finite(value):
        raise ConfigError(f"{what} must be a finite number, got {one_line(repr(value), 100)}")
    if not low <= value <= high:
        raise ConfigError(f"{what} must lie in [{low:g}, {high:g}], got {value!r}")
    return float(value)


def one_line(text: object, longest: int = 300) -> str:
    """A message from elsewhere as one line of printable characters, cut if it is too long."""
    line = " ".join("".join(c if c.isprintable() or c.isspace() else f"\\x{ord(c):02x}" for c in str(text)).split())
    return line if len(line) <= longest else f"{line[: longest - 3]}..."


def in_docstring(text: str) -> str:
    """Escape a text for the docstring of a generated module, so that nothing in it can end the string."""
    return one_line(text).replace("\\", "\\\\").replace('"', '\\"').encode("ascii", "backslashreplace").decode()


def without_password(url: str) -> str:
    """A storage's URL with its password hidden, even if the URL is mistyped.

    In doubt, more is hidden than needed: everything between the account's first colon and the last ``@``, and the value
    of each part of a query, fragment or connection string whose name means a secret.
    """
    head, mark, tail = re.match(r"([^?#]*)([?#]?)(.*)", url, re.DOTALL).groups()  # type: ignore[union-attr]
    scheme, head = _split_scheme(head)
    account, at, host = head.rpartition("@")
    if at:
        user, colon, _ = _split_account(account)
        head = f"{user}{colon}{HIDDEN if colon else ''}{at}{host}"
    elif scheme and not _looks_like_host(head):
        head = f"{head.partition(':')[0]}:{HIDDEN}"
    else:
        head = _hide_secrets(head)
    if "@" in tail and not at:  # the account stands behind the mark: a password with ? or # in it
        return f"{scheme}{head.partition(':')[0]}:{HIDDEN}@{tail.rpartition('@')[2]}"
    return f"{scheme}{head}{mark}{_hide_secrets(tail)}"


def _split_scheme(head: str) -> tuple[str, str]:
    """``postgresql+psycopg://`` and the rest; a mistyped scheme counts when an account may follow."""
    found = re.match(r"([A-Za-z][\w+.-]*:/*)(?=.*@)|([A-Za-z][\w+.-]+:/+)", head)
    if found is None or (found.group(1) and not found.group(1).endswith("/") and head.count(":") == 1):
        return "", head
    return found.group(), head[found.end() :]


def _split_account(account: str) -> tuple[str, str, str]:
    """User, colon and password; a colon may be written as ``%3A``."""
    found = re.search(r":|%3a", account, re.IGNORECASE)
    return (account, "", "") if found is None else (account[: found.start()], ":", account[found.end() :])


def _looks_like_host(head: str) -> bool:
    """Whether what follows the slashes is ``host:port/name`` or a path, rather than ``user:password``."""
    return (
        re.fullmatch(r"[^:]*|[^:/]*:\d{1,5}(/.*)?|/?[A-Za-z]:[\\/].*|\[[0-9a-fA-F:]+\](:\d+)?(/.*)?", head) is not None
    )


def _hide_secrets(text: str) -> str:
    """Hide the value after each name that means a secret, such as ``password``."""
    return SECRET.sub(rf"\g<1>{HIDDEN}", text)

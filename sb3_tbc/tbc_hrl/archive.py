"""Checks of a saved agent's ``.zip`` before anything in it is used."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import zipfile
from collections import deque
from pathlib import Path

from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.save_util import json_to_data

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.tbc_hrl.plain import NotPlainError, decode

DATA, PLAIN_DATA = "data", "plain.json"
POLICY = "policy_class"
PICKLED = ":serialized:"
"""Key of SB3 in ``data``: what lies under it is unpickled by SB3's own loading."""
MAX_MEMBERS = 200
MAX_DATA = 64 * 2**20
"""Largest ``data`` or ``plain.json``, bytes; ours have some 10,000."""
MAX_GROWTH = 20
SMALL = 2**20
"""Most bytes that a file may unpack to: ``MAX_GROWTH`` times its size plus ``SMALL``; SB3 does not compress at all."""
NEEDED = ("observation_space", "action_space", POLICY)
KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("observation_space", "action_space"), (spaces.Space,)),
    **dict.fromkeys(
        ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"), (int,)
    ),
    **dict.fromkeys(
        ("_updated_at", "_burst_due", "_stats_window_size", "n_envs", "verbose", "sde_sample_freq"), (int,)
    ),
    **dict.fromkeys(("_current_progress_remaining", "start_time"), (int, float)),
    **dict.fromkeys(("use_sde", "achieved_in_observation"), (bool,)),
    **dict.fromkeys(("seed", "episode_length"), (int, type(None))),
    **dict.fromkeys(("ep_info_buffer", "ep_success_buffer"), (deque, type(None))),
    **dict.fromkeys(("policy_kwargs", "settings"), (dict,)),
    "_owed": (dict, int, float),
    "tensorboard_log": (str, type(None)),
    "action_noise": (ActionNoise, type(None)),
    "subgoals": (SubgoalSpace, type(None)),
}
"""Entries of ``data`` that loading takes over as they stand, and what each may be."""
NAME = re.compile(r"[A-Za-z_][\w.]*")


class UntrustedError(ConfigError):
    """Loading would run code from the file, and the caller did not say that the file is trusted."""


def read_bytes(path: str | Path | io.BufferedIOBase) -> bytes:
    """The whole file; as in SB3, the ending ``.zip`` may be left out.

    :raises ConfigError: if it is missing or cannot be read
    :raises TypeError: if it is neither a path nor an open file
    """
    if hasattr(path, "read") and hasattr(path, "seek"):
        path.seek(0)  # as SB3 does not mind where writing has left it
        return path.read()
    if not isinstance(path, str | Path):
        raise TypeError(
            f"an agent is loaded from the path of its .zip, or from an open file, got {one_line(repr(path))}"
        )
    given = Path(path)
    file = given if given.suffix or os.path.isfile(given) or not given.name else given.with_suffix(".zip")
    try:
        return file.read_bytes()
    except FileNotFoundError as error:
        raise ConfigError(f"no such file: {file} (an agent is saved as .zip by train or model.save)") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {file}: {one_line(error)}") from error


def read_data(content: bytes, name: str) -> Plain:
    """Check the whole file of an agent; return its table ``data``, which gets the table ``plain.json`` as an entry.

    :param content: of the file
    :param name: of the file, for messages
    :raises ConfigError: if it is damaged, is not an agent, or holds what no agent holds
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_members(archive, len(content), name)
            broken = archive.testzip()
            if broken is not None:
                raise ConfigError(f"{name} is damaged: {one_line(broken)} fails its checksum")
            for member in archive.namelist():
                if member.endswith(".pth"):
                    _check_weights(archive.read(member), f"{name}, {member}")
            data = _table(archive, DATA, name)
            if PLAIN_DATA in archive.namelist():
                data[PLAIN_DATA] = _table(archive, PLAIN_DATA, name)
            return data
    except ConfigError:
        raise
    except Exception as error:  # zipfile, zlib and json raise many kinds of errors for a broken file
        text = one_line(error)
        raise ConfigError(f"{name} is not a complete agent .zip (truncated or another format): {text}") from error


def _check_members(archive: zipfile.ZipFile, size: int, name: str) -> None:
    members = archive.infolist()
    names = [member.filename for member in members]
    for member in members:
        if not NAME.fullmatch(member.filename) or member.flag_bits & 1:
            raise ConfigError(
                f"{name} is not a complete agent .zip (truncated or another format): it holds "
                f"{one_line(repr(member.filename))}, which no agent holds"
            )
    if len(members) > MAX_MEMBERS or len(set(names)) < len(names):
        raise ConfigError(f"{name} holds {len(members)} files, some of them twice; no agent does")
    if sum(member.file_size for member in members) > MAX_GROWTH * size + SMALL:
        raise ConfigError(f"{name} would unpack to far more than its {size} bytes; no agent does")


def _check_weights(content: bytes, name: str) -> None:
    """Look into a file of weights, itself a ``.zip``, for one that would unpack to far more than its size."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return  # not a zip: torch refuses it
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(member.file_size for member in archive.infolist()) > MAX_GROWTH * len(content) + SMALL:
            raise ConfigError(f"{name} would unpack to far more than its {len(content)} bytes; no agent does")


def _table(archive: zipfile.ZipFile, member: str, name: str) -> Plain:
    if archive.getinfo(member).file_size > MAX_DATA:
        raise ConfigError(f"{name}: {member} has more than {MAX_DATA} bytes")
    table = json.loads(archive.read(member))
    if not isinstance(table, dict):
        raise ConfigError(f"{name} is not an agent .zip: its {member} is no table")
    return table


def pickled_keys(data: Plain) -> list[str]:
    """The entries of ``data`` that SB3 would unpickle."""
    return [key for key, value in data.items() if isinstance(value, dict) and PICKLED in value]


def policy_of(data: Plain, trust: bool) -> object:
    """The class of the saved policy, or the name of its module if only unpickling could tell the class.

    :param data: as :func:`read_data` gave it
    :param trust: whether it may be unpickled
    """
    entry, plain = data.get(POLICY), data.get(PLAIN_DATA, {})
    if POLICY in plain:
        with contextlib.suppress(NotPlainError, RecursionError):
            return decode(plain[POLICY])
    if trust:
        return json_to_data(json.dumps({POLICY: entry}))[POLICY]
    return entry.get("__module__") if isinstance(entry, dict) else None


def unpickled(data: Plain, name: str, given: Plain, has_env: bool) -> Plain:
    """For SB3's ``custom_objects``: a plain value for every entry that it would unpickle otherwise.

    :param data: as :func:`read_data` gave it
    :param name: of the file, for messages
    :param given: values that the caller has for some entries
    :param has_env: whether the caller brings an environment, whose own subgoal space then takes the place of one
        without a plain form
    :raises UntrustedError: if an entry has no plain value that makes sense, or the file contains an environment
    """
    plain = data.get(PLAIN_DATA, {})
    if "env" in data:
        raise UntrustedError(f"{name} contains an environment, which can run any code; {CURE}")
    values: Plain = {}
    for key in pickled_keys(data):
        if key in given:
            continue
        if has_env and key == "subgoals" and not _has_form(plain.get(key)):
            values[key] = None
            continue
        if key not in plain:
            raise UntrustedError(f"{name} holds {one_line(key)!r} as a pickle, which can run any code; {CURE}")
        try:
            values[key] = decode(plain[key])
        except (NotPlainError, RecursionError) as error:
            text = f"{name}: {one_line(key)} in {PLAIN_DATA} makes no sense here: {one_line(error)}"
            raise UntrustedError(f"{text}; {CURE}") from error
    return values


def check_entries(found: PlainMapping, name: str) -> None:
    """Check what loading takes over from a file as it stands.

    :param found: entries of ``data`` by name; those that are still pickled are not looked at
    :param name: of the file, for messages
    :raises ConfigError: if one is missing, or of another kind
    """
    for key in NEEDED:
        if key not in found:
            raise ConfigError(f"{name} is damaged: it has no entry {key}")
    for key, kinds in KINDS.items():
        value = found.get(key)
        if key in found and not (isinstance(value, kinds) or (isinstance(value, dict) and PICKLED in value)):
            allowed = " or ".join("null" if kind is type(None) else kind.__name__ for kind in kinds)
            raise ConfigError(f"{name} is damaged: its entry {key} must be {allowed}, got {one_line(repr(value), 100)}")


def _has_form(data: object) -> bool:
    try:
        return decode(data) is not None
    except (NotPlainError, RecursionError):
        return False


CURE = "if you trust where it comes from, load it with trust=True (commands: --trust)"


def with_plain(content: bytes, plain: Plain) -> bytes:
    """The file with the table ``plain.json`` added."""
    buffer = io.BytesIO(content)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(PLAIN_DATA, json.dumps(plain, indent=1))
    return buffer.getvalue()

"""Checkpoints of a run: the last two are kept, with checksums that reveal a damaged file.

A new checkpoint is first written completely under another name and then renamed. The oldest is removed only after that.
So whenever the process dies, the folder holds at least one complete checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import digest, explained, remove, sync, write_atomic

NEWEST, BEFORE, BROKEN = "checkpoint", "checkpoint.old", "checkpoint.broken"
UNFINISHED = "checkpoint.new*"
MODEL, REPLAY, STATE, BEST = "model.zip", "replay_buffer.pkl", "state.json", "best_model.zip"
KEPT = "kept"
"""In a checkpoint's state: whether it stays when the run is finished."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint whose files are complete and undamaged.

    :param path: its folder
    :param timesteps: environment steps done
    :param wall_time: seconds they took, evaluations included
    """

    path: Path
    timesteps: int
    wall_time: float

    @property
    def model(self) -> Path:
        """The agent."""
        return self.path / MODEL

    @property
    def replay_buffer(self) -> Path:
        """Replay buffers, random streams, running episodes."""
        return self.path / REPLAY

    @property
    def best_model(self) -> Path:
        """The run's best agent so far; there is none before the first evaluation."""
        return self.path / BEST


def save_checkpoint(
    run: Path,
    timesteps: int,
    wall_time: float,
    save_model: Callable[[Path], object],
    save_replay: Callable[[Path], object],
    kept: bool = False,
) -> None:
    """Write a checkpoint into a run's folder; the previous one is kept, the one before that is removed.

    :param save_model: writes the agent to a path
    :param save_replay: writes the replay buffers to a path
    :param kept: whether it is to stay when the run is finished; remembered for the run's later parts
    :raises WriteError: if it cannot be written; the earlier checkpoints are then unchanged
    """
    newest, before, new = run / NEWEST, run / BEFORE, run / "checkpoint.new"
    remove_unfinished(run)
    try:
        with explained(newest):
            new.mkdir(parents=True)
            save_model(new / MODEL)
            save_replay(new / REPLAY)
            if (run / BEST).is_file():  # a later one would be of an evaluation that a resumed run repeats
                shutil.copyfile(run / BEST, new / BEST)
            for path in new.iterdir():
                sync(path)
            write_atomic(new / STATE, _state(new, timesteps, wall_time, kept))
            sync(run)
    except BaseException:
        remove(new)
        raise
    with explained(newest):
        if newest.exists():
            remove(before)
            newest.rename(before)
        new.rename(newest)
        sync(run)
    remove(run / BROKEN)


def _state(folder: Path, timesteps: int, wall_time: float, kept: bool) -> str:
    state = {
        "timesteps": timesteps,
        "wall_time": wall_time,
        KEPT: kept,
        "sha256": {path.name: digest(path) for path in sorted(folder.iterdir())},
    }
    return json.dumps({**state, "state_sha256": _sum_of(state)}, indent=2) + "\n"


def _sum_of(state: Plain) -> str:
    return hashlib.sha256(json.dumps(state, sort_keys=True).encode()).hexdigest()


def find_checkpoint(run: Path) -> Checkpoint | None:
    """The newest undamaged checkpoint of a run, or None if there is no checkpoint. Damaged ones are named in the log.

    :raises ConfigError: if all checkpoints are damaged; the message names each file
    """
    damage: list[str] = []
    for folder in _candidates(run):
        try:
            found = read_checkpoint(folder)
        except ConfigError as error:
            damage.append(str(error))
            continue
        if damage:
            logger.warning(f"{'; '.join(damage)}; resuming from the previous checkpoint, at {found.timesteps} steps")
        return found
    if damage:
        raise ConfigError(f"no undamaged checkpoint: {'; '.join(damage)}; start the run again with --overwrite")
    return None


def has_checkpoint(run: Path) -> bool:
    """Whether there is a checkpoint, damaged or not."""
    return any(True for _ in _candidates(run))


def steps_done(run: Path) -> int:
    """Environment steps of the newest checkpoint as it says itself, 0 without one; no other file is read."""
    return _said(run, "timesteps", 0)


def is_kept(run: Path) -> bool:
    """Whether the newest checkpoint says that it stays when the run is finished; no other file is read."""
    return bool(_said(run, KEPT, 0))


def _said(run: Path, name: str, missing: int) -> int:
    for folder in _candidates(run):
        try:
            return int(json.loads((folder / STATE).read_text(encoding="utf-8"))[name])
        except (OSError, ValueError, TypeError, KeyError, RecursionError, OverflowError):
            continue
    return missing


def _candidates(run: Path) -> Iterator[Path]:
    return (run / name for name in (NEWEST, BEFORE) if (run / name).is_dir())


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read a checkpoint's state and check its files against their checksums; earlier versions stored none.

    :raises ConfigError: naming the damaged or missing file
    """
    path = folder / STATE
    try:
        state = json.loads(path.read_text(encoding="utf-8"))
        given = state.pop("state_sha256", None)
        if given is not None and given != _sum_of(state):
            raise ValueError("it fails its checksum")
        found = Checkpoint(folder, int(state["timesteps"]), float(state["wall_time"]))
        sums = dict(state.get("sha256", {}))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        raise ConfigError(f"{path} is damaged ({error})") from error
    for name in (MODEL, REPLAY, *({BEST} & sums.keys())):
        if not (folder / name).is_file():
            raise ConfigError(f"{folder / name} is missing")
        if name in sums and sums[name] != digest(folder / name):
            raise ConfigError(f"{folder / name} is damaged: it fails its checksum")
    return found


def keep_only(run: Path, checkpoint: Checkpoint) -> Checkpoint:
    """Make a checkpoint the newest, so that the next one does not replace it; a damaged newer one is renamed.

    :return: the same checkpoint under its new name
    """
    if checkpoint.path.name == NEWEST:
        return checkpoint
    newest = run / NEWEST
    with explained(newest):
        if newest.exists():
            remove(run / BROKEN)
            newest.rename(run / BROKEN)
        checkpoint.path.rename(newest)
        sync(run)
    return Checkpoint(newest, checkpoint.timesteps, checkpoint.wall_time)


def remove_unfinished(run: Path) -> None:
    """Remove half-written checkpoints that killed processes left behind."""
    for folder in run.glob(UNFINISHED):
        remove(folder)


def remove_checkpoints(run: Path) -> None:
    """Remove all of a run's checkpoints, the oldest first."""
    remove_unfinished(run)
    for name in (BROKEN, BEFORE, NEWEST):
        remove(run / name)

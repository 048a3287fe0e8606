"""What the plots of SB3 and rl_zoo3 read of a run: ``evaluations.npz``, and the monitor file of training."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Collection
from pathlib import Path

import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import Arrays
from sb3_tbc.files import write_arrays
from sb3_tbc.reading import read_arrays
from sb3_tbc.tbc_hrl.evaluation import EvaluationResult
from sb3_tbc.zoo.rows import RowsCallback

COLUMNS = ("results", "ep_lengths", "successes")
EVALUATION_EPISODES, MONITOR = "evaluations.npz", "train.monitor.csv"
MOST_EPISODES = 200_000
"""Episodes of training that the monitor file holds at most, some 8 MB."""

logger = logging.getLogger(__name__)


class EvaluationEpisodes:
    """Every episode of every evaluation, written as SB3's ``EvalCallback`` does.

    :param path: the file; none writes nothing
    :param steps: evaluations at these steps are kept if the file holds them, others belong to what is done anew
    """

    def __init__(self, path: Path | None, steps: Collection[int] = ()) -> None:
        self.path = path
        self._rows = {step: row for step, row in _read(path).items() if step in steps}

    def add(self, timesteps: int, result: EvaluationResult) -> None:
        """Write an evaluation to the file.

        :raises WriteError: if it cannot be written
        """
        row = dict(zip(COLUMNS, (result.rewards, result.lengths, result.successes), strict=True))
        alike = {step: old for step, old in self._rows.items() if len(old["results"]) == len(result.rewards)}
        self._rows = {**alike, timesteps: row}
        if self.path is not None:
            columns = {name: np.stack([row[name] for row in self._rows.values()]) for name in row}
            write_arrays(self.path, {"timesteps": np.array(list(self._rows)), **columns})


def _read(path: Path | None) -> dict[int, Arrays]:
    """Evaluations by step; none where there is no file, or a damaged one, which only plots would miss."""
    if path is None or not path.is_file():
        return {}
    try:
        arrays = read_arrays(path)
        steps, columns = arrays["timesteps"].tolist(), {name: arrays[name] for name in COLUMNS}
        return {int(step): {name: array[i] for name, array in columns.items()} for i, step in enumerate(steps)}
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        logger.warning(f"{path} cannot be read and is begun anew: {error}")
        return {}


class TrainingMonitor(RowsCallback):
    """Writes every episode of training as SB3's ``Monitor`` does, which a resumed run goes on with.

    A ``Monitor`` of its own begins its file anew, and would keep episodes that a resumed run lives through again.

    :param path: the file
    :param env_id: environment id, for the file's first line
    :param earlier: seconds that earlier parts of the run took
    :param most: episodes that the file holds at most
    """

    def __init__(self, path: Path, env_id: str, earlier: float = 0.0, most: int = MOST_EPISODES) -> None:
        super().__init__(path)
        self.env_id, self.most = env_id, most
        self._began = time.time() - earlier
        self._written = 0

    def head(self) -> str:
        """SB3's first line, and the names of the columns."""
        first = json.dumps({"t_start": self._began, "env_id": self.env_id})
        return f"#{first}\ntimesteps,r,l,t,is_success\n"

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._written = sum(1 for _ in self.path.open(encoding="utf-8")) - 2

    def _on_step(self) -> bool:
        dones = self.locals["dones"]
        if np.count_nonzero(dones):
            for index in np.flatnonzero(dones):
                self._note(int(index), self.locals["infos"][index])
        return True

    def _note(self, index: int, info: Plain) -> None:
        told = info.get("episode")
        if told is None or self._written >= self.most:
            return
        self._written += 1
        finished = self.locals.get("episodes", {}).get(index)
        success = info.get("is_success") if finished is None else finished.success
        seconds = round(time.time() - self._began, 3)
        self.write([told["r"], told["l"], seconds, "" if success is None else int(success)])
        if self._written == self.most:
            logger.warning(f"{self.path} holds {self.most} episodes and ends here; evaluations go on")

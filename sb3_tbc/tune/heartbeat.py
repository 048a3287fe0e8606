"""Storages with a heartbeat of running trials, so that the trials of dead workers are found."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path

from optuna.storages import RDBStorage
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages._rdb import models
from optuna.storages.journal import JournalStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from sb3_tbc.tune.journal import WholeLines

Retry = Callable[[Study, FrozenTrial], None]


class JournalWithHeartbeat(JournalStorage, BaseHeartbeat):
    """A journal file with a heartbeat of running trials; Optuna has one for databases, but not for journals.

    The heartbeat is the modification time of a small file beside the journal, measured by the file system's clock.

    :param path: the journal
    :param interval: seconds between heartbeats
    :param grace: seconds without a heartbeat after which a trial is given to another worker
    :param callback: called with such a trial
    """

    def __init__(self, path: Path, interval: int, grace: int, callback: Retry) -> None:
        super().__init__(WholeLines(path))
        self._folder = path.with_name(path.name + ".alive")
        self._folder.mkdir(exist_ok=True)
        self._interval, self._grace, self._callback = interval, grace, callback

    def record_heartbeat(self, trial_id: int) -> None:
        """Record that a trial's worker is alive."""
        (self._folder / f"trial_{trial_id}").touch()

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
        if not running:
            return []
        clock = self._folder / "clock"
        clock.touch()
        now = clock.stat().st_mtime
        return [t._trial_id for t in running if now - self._last_sign(t) > self._grace]

    def _last_sign(self, trial: FrozenTrial) -> float:
        try:
            return (self._folder / f"trial_{trial._trial_id}").stat().st_mtime
        except FileNotFoundError:
            return (trial.datetime_start or datetime.datetime.now()).timestamp()

    def get_heartbeat_interval(self) -> int:
        """Seconds between heartbeats."""
        return self._interval

    def get_heartbeat_stale_trial_callback(self) -> Retry:
        """The function that queues a dead worker's trial again."""
        return self._callback


class DatabaseWithHeartbeat(RDBStorage):
    """A database that also notices trials whose worker died before the first heartbeat.

    Optuna looks at trials with a heartbeat only: the others would count as running for ever.
    """

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        found: list[int] = super()._get_stale_trial_ids(study_id)
        running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
        grace = self.grace_period or 2 * (self.heartbeat_interval or 60)
        oldest = datetime.datetime.now() - datetime.timedelta(seconds=grace)
        begun = [t._trial_id for t in running if t.datetime_start is not None and t.datetime_start < oldest]
        if begun:
            with self.scoped_session() as session:
                rows = session.query(models.TrialHeartbeatModel.trial_id)
                alive = {row[0] for row in rows.filter(models.TrialHeartbeatModel.trial_id.in_(begun))}
            found += [number for number in begun if number not in alive and number not in found]
        return found

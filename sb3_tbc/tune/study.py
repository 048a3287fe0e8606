"""Studies of a search: storages with a heartbeat, the settings that all trials share, samplers by name."""

from __future__ import annotations

import contextlib
import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.storages import BaseStorage, RetryHeartbeatStaleTrialCallback, fail_stale_trials
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.files import explained, write_atomic
from sb3_tbc.outside import HIDDEN, one_line, without_password
from sb3_tbc.tune.heartbeat import DatabaseWithHeartbeat, JournalWithHeartbeat
from sb3_tbc.tune.journal import drop_half_line
from sb3_tbc.tune.objectives import OBJECTIVES
from sb3_tbc.tune.search_space import Space, Values, apply, build_space, project, suggest
from sb3_tbc.zoo.config import RunConfig

SETTINGS = "settings"
"""Study attribute with :class:`StudySettings`."""
ORIGIN = "origin"
"""Trial attribute of the first trials: name of their configuration, ``paper``, ``tuned`` or ``default``."""
REASON = "reason"
"""Trial attribute: why a trial was pruned."""
WORKER = "worker"
"""Trial attribute: the worker that runs it."""
LONGEST_WAIT = 20.0
"""Seconds to wait for the settings of a study that another machine is creating."""
COUNTED = (TrialState.COMPLETE, TrialState.PRUNED)
"""States of trials that are done; a failed trial is not, because it is run again."""
MAX_RETRIES = 3
shown = without_password
JOURNAL_SUFFIXES = (".log", ".journal")

optuna.logging.set_verbosity(optuna.logging.ERROR)
IN_MEMORY = re.compile(r"sqlite(\+\w+)?:/{2,3}(:memory:)?(\?.*)?")
"""Databases that end with the connection that began them."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Optuna's warnings about features that it still calls experimental."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield


@dataclass(frozen=True)
class StudySettings:
    """Settings that all trials of a study share, stored with the study, so that a resumed search compares equal trials.

    :param algo: algorithm
    :param env: environment as the user named it (``module:id`` imports the module first)
    :param task: its short name
    :param env_id: its id
    :param base: configuration (as plain data) of everything that is not searched
    :param baselines: name -> configuration of the first trials
    :param space: declaration of the search space
    :param n_seeds: training runs per trial
    :param first_seed: their seeds are ``first_seed, first_seed + 1, ...``, the same in every trial
    :param objective: one of :data:`~sb3_tbc.tune.objectives.OBJECTIVES`
    :param across_seeds: ``mean`` or ``median``
    :param threshold: success rate that ``steps-to-success`` waits for
    :param eval_freq: environment steps between evaluations
    :param n_eval_episodes: episodes per evaluation
    :param n_final_episodes: episodes of the evaluation after training
    :param asked: command-line options of the study, against which those of a resuming command are checked
    """

    algo: str
    env: str
    task: str
    env_id: str
    base: Plain
    baselines: dict[str, Plain]
    space: dict[str, Plain]
    n_seeds: int
    first_seed: int
    objective: str
    across_seeds: str
    threshold: float
    eval_freq: int
    n_eval_episodes: int
    n_final_episodes: int
    asked: Plain

    @property
    def run(self) -> RunConfig:
        """The configuration on which trials are based."""
        return RunConfig.from_dict(self.base)

    @property
    def parameters(self) -> Space:
        """The search space."""
        return build_space(self.space)

    @property
    def seeds(self) -> range:
        """Training seeds of every trial."""
        return range(self.first_seed, self.first_seed + self.n_seeds)

    @property
    def n_evaluations(self) -> int:
        """Upper limit of the evaluations in a training run; parallel environments may overshoot by a step or two."""
        return self.run.n_timesteps // self.eval_freq + 1

    @property
    def direction(self) -> Literal["minimize", "maximize"]:
        """Whether the objective is maximised or minimised."""
        return OBJECTIVES[self.objective].direction

    def first_trials(self) -> dict[str, Values]:
        """Parameter values of the baselines."""
        return {name: project(self.parameters, RunConfig.from_dict(run)) for name, run in self.baselines.items()}

    def config_of(self, trial: FrozenTrial) -> RunConfig:
        """The configuration of a trial; that of a baseline is returned as it is, with values outside the space, too."""
        return self.config_of_values(trial.user_attrs.get(ORIGIN), trial.params)

    def config_of_values(self, origin: str | None, values: Values) -> RunConfig:
        """The configuration of a baseline, or of a trial with these values."""
        if origin in self.baselines:
            return RunConfig.from_dict(self.baselines[origin])
        return apply(self.parameters, values, self.run)


def is_url(storage: str) -> bool:
    """Whether a storage is a database rather than a journal file."""
    return "://" in storage


def open_storage(storage: str, grace: int = 120) -> BaseStorage:
    """Open a journal file (created with its folder) or a database, with a heartbeat either way.

    :param storage: path ending in ``.log`` or ``.journal``, or a URL like ``postgresql+psycopg://user@host/name``
    :param grace: seconds without a heartbeat after which a trial is given to another worker
    :raises ConfigError: if it cannot be opened; the message does not contain the password
    """
    try:
        with _quiet():
            return _open(storage, grace)
    except ConfigError:
        raise
    except Exception as error:  # database drivers raise errors of any type
        raise ConfigError(f"cannot open storage {shown(storage)}: {_first_line(error, storage)}") from error


def _open(storage: str, grace: int) -> BaseStorage:
    retry, interval = RetryHeartbeatStaleTrialCallback(max_retry=MAX_RETRIES), max(1, grace // 4)
    if is_url(storage):
        if IN_MEMORY.fullmatch(storage):
            raise ConfigError(
                f"storage {storage} lives in the memory of one connection, and a search has several: name a file, "
                "e.g. sqlite:///study.db"
            )
        database = DatabaseWithHeartbeat(
            storage,
            engine_kwargs={"pool_pre_ping": True},
            heartbeat_interval=interval,
            grace_period=grace,
            heartbeat_stale_trial_callback=retry,
        )
        return optuna.storages.get_storage(database)
    path = Path(storage)
    if path.suffix not in JOURNAL_SUFFIXES:
        raise ConfigError(
            f"storage must be a journal file ending in {' or '.join(JOURNAL_SUFFIXES)}, or a URL like "
            f"sqlite:///study.db or postgresql+psycopg://user@host/name; got {shown(storage)!r}"
        )
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        drop_half_line(path)
    return JournalWithHeartbeat(path, interval, grace, retry)


def _first_line(error: Exception, storage: str) -> str:
    """First line of a driver's message, with the password hidden wherever it occurs."""
    if isinstance(error, optuna.exceptions.StorageInternalError) and isinstance(error.__cause__, Exception):
        error = error.__cause__  # Optuna's own words are the same for every failure of a database
    text = str(error).replace(storage, shown(storage)).strip() or type(error).__name__
    before, hidden, after = shown(storage).partition(HIDDEN)
    secret = storage[len(before) : len(storage) - len(after)] if hidden else ""
    text = text.replace(secret, HIDDEN) if len(secret) > 2 else text
    return one_line(text.splitlines()[0])


@contextlib.contextmanager
def readable(storage: str) -> Iterator[None]:
    """Turn errors of reading a storage in this context into a message of one line.

    :param storage: its name
    :raises ConfigError: if it cannot be read; the message does not contain the password
    """
    try:
        yield
    except (ConfigError, OSError):
        raise
    except Exception as error:  # damaged data raise errors of any type
        text = _first_line(error, storage)
        raise ConfigError(f"cannot read storage {shown(storage)}, it may be damaged: {text}") from error


@contextlib.contextmanager
def told_if_lost(storage: str) -> Iterator[None]:
    """Turn a database's failure during a search, e.g. one that is locked or gone, into a message of one line.

    :param storage: its name
    :raises ConfigError: if it fails; the message does not contain the password
    """
    try:
        yield
    except optuna.exceptions.StorageInternalError as error:
        text = _first_line(error, storage)
        raise ConfigError(f"storage {shown(storage)} has failed: {text}; the same command continues") from error


def claim_folder(folder: Path, storage: str, fresh: bool) -> None:
    """Reserve a folder for the runs of one study, so that studies of the same name in other storages cannot use it.

    :param folder: folder of the study's runs
    :param storage: name of the storage
    :param fresh: whether the study is new
    :raises ConfigError: if the folder holds the runs of another study
    """
    marker, own = folder / "storage.txt", shown(storage) if is_url(storage) else str(Path(storage).resolve())
    known = marker.read_text(encoding="utf-8", errors="replace").strip() if marker.is_file() else None
    taken = known != own if known is not None else fresh and any(folder.glob("trial_*"))
    if taken:
        raise ConfigError(
            f"{folder} holds the runs of another study (storage {known or 'unknown'}); use another --study-name or "
            "--log-folder"
        )
    if known is None:
        write_atomic(marker, own + "\n")


def names(storage: BaseStorage) -> set[str]:
    """Names of the studies in a storage."""
    return set(optuna.get_all_study_names(storage))


def open_study(
    storage: BaseStorage, name: str, where: str, wanted: StudySettings | None, asked: PlainMapping
) -> tuple[Study, StudySettings]:
    """Load the study of this name, or create it with its first trials queued.

    :param where: the storage's name, for messages
    :param wanted: settings of a new study; None to load only
    :param asked: the options given now; those of an existing study must agree
    :raises ConfigError: if there is none to load, or it was begun with other options
    """
    known = names(storage)
    if name not in known:
        if wanted is None:
            there = f"; {nearest(name, known)}" if known else "; it holds no study yet"
            raise ConfigError(f"no study {name!r} in {where}{there}")
        with contextlib.suppress(optuna.exceptions.DuplicatedStudyError):  # another machine was faster
            study = optuna.create_study(storage=storage, study_name=name, direction=wanted.direction)
            study.set_user_attr(SETTINGS, asdict(wanted))
    study = optuna.load_study(study_name=name, storage=storage)
    _wait_for_settings(study)
    settings = read_settings(study)
    check_same(settings, name, asked)
    queue_first_trials(study, settings)
    return study, settings


def _wait_for_settings(study: Study) -> None:
    """Wait while another machine creates the study, which then has neither trials nor settings yet."""
    for _ in range(round(10 * LONGEST_WAIT)):
        if SETTINGS in study.user_attrs or study.get_trials(deepcopy=False):
            return
        time.sleep(0.1)


def read_settings(study: Study) -> StudySettings:
    """The settings that a study's trials share.

    :raises ConfigError: if this command did not make the study
    """
    data = study.user_attrs.get(SETTINGS)
    try:
        return StudySettings(**data)  # type: ignore[arg-type]
    except TypeError as error:
        raise ConfigError(f"study {study.study_name!r} was not made by this command or version") from error


def check_same(settings: StudySettings, name: str, asked: PlainMapping) -> None:
    """Refuse options that would make a study's trials incomparable.

    :raises ConfigError: naming the option and both values
    """
    cure = "continue it with its own options, or begin another with --study-name"
    begun = {**settings.asked, "algo": settings.algo, "env": settings.task}
    for option, value in asked.items():
        if value is not None and begun.get(option) != value:
            kind = "is of another algorithm" if option == "algo" else "was begun with other options"
            flag = f"--{option.replace('_', '-')}"
            raise ConfigError(f"study {name!r} {kind}: {flag} is {begun.get(option)} there, not {value}; {cure}")


def queue_first_trials(study: Study, settings: StudySettings) -> None:
    """Queue the baselines that are neither done, nor running, nor queued."""
    trials = study.get_trials(deepcopy=False)
    there = {t.user_attrs.get(ORIGIN) for t in trials if t.state != TrialState.FAIL}
    for origin, values in settings.first_trials().items():
        if origin not in there:
            study.enqueue_trial(values, user_attrs={ORIGIN: origin})


def count_done(study: Study) -> int:
    """Number of trials that are complete or pruned; a failed trial and its retry count once."""
    return len(study.get_trials(deepcopy=False, states=COUNTED))


def retire_stale(study: Study) -> None:
    """Give the trials of dead workers back to the queue."""
    with _quiet():
        fail_stale_trials(study)


def requeue(study: Study, trial: FrozenTrial, most: int | None = None) -> bool:
    """Put a trial back into the queue, with the seeds it has finished, and return whether that was done.

    :param most: how often a trial is run again at most, by default without end
    """
    retries = len(trial.system_attrs.get("retry_history", ()))
    with _quiet():
        RetryHeartbeatStaleTrialCallback(max_retry=most)(study, trial)
    return most is None or retries < most


# --------------------------------------------------------------------------------------------- samplers


def make_sampler(name: str, seed: int | None, stream: tuple[int, ...] = ()) -> optuna.samplers.BaseSampler:
    """A sampler by name: ``tpe``, ``random``, or any class of ``optuna.samplers``.

    TPE is multivariate, treats conditional parameters separately, and avoids the values of trials that still run.

    :param seed: seed; of another ``stream`` come other numbers
    :raises ConfigError: for an unknown name or one that needs arguments or a package
    """
    known = {n.removesuffix("Sampler").lower(): n for n in optuna.samplers.__all__ if n.endswith("Sampler")}
    known.pop("base", None)
    key = name.removesuffix("Sampler").lower()
    if key not in known or key.startswith("base"):
        raise ConfigError(f"unknown sampler {name!r}; {nearest(key, known)}")
    options: Plain = {}
    if seed is not None:
        own = () if key == "qmc" else stream  # one sequence for all, whose place the storage keeps
        options["seed"] = int(np.random.SeedSequence([seed, *own]).generate_state(1)[0])
    if key == "tpe":
        options.update(multivariate=True, group=True, constant_liar=True)
    try:
        with _quiet():
            sampler: optuna.samplers.BaseSampler = getattr(optuna.samplers, known[key])(**options)
    except (TypeError, ImportError) as error:
        raise ConfigError(f"sampler {name!r} cannot be used by name: {error}; use tpe or random") from error
    return sampler


class SamplerOfEachTrial(optuna.samplers.BaseSampler):
    """Draws each trial from a stream of its own, given by its number, which no two processes share.

    A stream for each process would do only if it knew of all others: the same command on two machines, or given twice,
    would draw each trial twice.

    :param make: gives the sampler of a trial by its number
    """

    def __init__(self, make: Callable[[int], optuna.samplers.BaseSampler]) -> None:
        self._make, self._sampler = make, make(0)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Begin the stream of a trial."""
        self._sampler = self._make(trial.number)
        self._sampler.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """Which parameters are drawn together."""
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> Plain:
        """Draw these."""
        return self._sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> object:
        """Draw a parameter by itself."""
        return self._sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Let the sampler see how the trial ended."""
        self._sampler.after_trial(study, trial, state, values)


def try_sampler(name: str, settings: StudySettings) -> None:
    """Draw a few trials, so that an unsuitable sampler is reported before the first run.

    :raises ConfigError: if it fails
    """
    try:
        study = optuna.create_study(sampler=make_sampler(name, 0), direction=settings.direction)
        for k in range(TRIED):
            trial = study.ask()
            suggest(settings.parameters, trial, None)
            study.tell(trial, float(k % 3))
    except ConfigError:
        raise
    except Exception as error:
        text = one_line(error)
        raise ConfigError(f"sampler {name!r} cannot search this space: {text}; use tpe or random") from error


TRIED = 12
"""Number of trials drawn to test a sampler; most samplers draw the first ten at random."""

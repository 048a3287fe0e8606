"""Search spaces: ranges are read from YAML, a trial chooses values, and the values become a configuration.

Nothing here imports Optuna: a space is data, and a trial is any object with ``suggest_float``, ``suggest_int`` and
``suggest_categorical``.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Protocol, TypeGuard

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import is_finite
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.reading import SettingsLoader, read_yaml
from sb3_tbc.settings import merge
from sb3_tbc.tbc_hrl.level_config import CircuitConfig
from sb3_tbc.zoo.config import RunConfig, changed, nested
from sb3_tbc.zoo.schema import CONFIG_CLASSES, RUN, validate

Label = str | int | float | bool | None
"""A value of a parameter: a number of its range, or one of its choices (the types that Optuna allows)."""

Values = Plain
"""Parameter name -> value, as a trial holds it."""

SCHEDULE = "learning_rate_schedule"
"""Parameter without a value of its own: with ``linear`` the learning rates among its keys fall to zero."""
SCHEDULES = ("constant", "linear")
RATES = ("low.learning_rate", "low.actor_learning_rate", "high.learning_rate")
FALLBACK = {"low.actor_learning_rate": "low.learning_rate"}
"""What holds where a setting is not set: an actor without a learning rate of its own has its critics'."""
FIELDS = ("low", "high", "log", "step", "choices", "keys", "when")
CIRCUIT = "low.policy_kwargs.ndbc"
SHARED = "n_timesteps"
"""Setting that is the same in all trials of a search."""


class Suggests(Protocol):
    """The part of ``optuna.Trial`` that a space needs."""

    def suggest_float(self, name: str, low: float, high: float, *, step: float | None, log: bool) -> float:
        """Return a number."""

    def suggest_int(self, name: str, low: int, high: int, *, step: int, log: bool) -> int:
        """Return a whole number."""

    def suggest_categorical(self, name: str, choices: Sequence[Label]) -> Label:
        """Return one of the choices."""


@dataclass(frozen=True)
class Parameter:
    """One searched quantity.

    :param name: name in the study
    :param keys: dotted keys of the configuration that get the value
    :param low: lower end of a range, inclusive; whole if both ends are
    :param high: upper end
    :param log: sample the logarithm uniformly
    :param step: spacing, None for none
    :param choices: labels instead of a range
    :param sets: label -> dotted keys and their values, if a label stands for several settings or for another value
    :param when: only if another parameter has this value
    """

    name: str
    keys: tuple[str, ...]
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    step: float | None = None
    choices: tuple[Label, ...] = ()
    sets: Mapping[Label, PlainMapping] = field(default_factory=dict)
    when: tuple[str, object] | None = None

    @property
    def whole(self) -> bool:
        """Whether the range is one of whole numbers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    def suggest(self, trial: Suggests) -> Label:
        """Let a trial choose."""
        if self.choices:
            return trial.suggest_categorical(self.name, self.choices)
        if self.whole:
            return trial.suggest_int(self.name, int(self.low), int(self.high), step=int(self.step or 1), log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, step=self.step, log=self.log)

    def settings(self, value: Label) -> Values:
        """Dotted configuration keys for a value."""
        return dict(self.sets[value]) if self.sets else dict.fromkeys(self.keys, value)

    def holds(self, value: object) -> TypeGuard[str | float]:
        """Whether a value lies in the range or among the choices."""
        if self.choices:
            return value in self.choices
        if isinstance(value, bool) or not isinstance(value, int | float) or not self.low <= value <= self.high:
            return False
        step = self.step or (1 if self.whole else None)
        place = 0.0 if step is None else (value - self.low) / step
        return abs(place - round(place)) < 1e-8  # as Optuna tells whether a number lies on the grid

    def read(self, run: RunConfig) -> object:
        """The value that corresponds to a configuration's settings, None if there is none."""
        if self.name == SCHEDULE:
            keys = [key for key in self.keys if key not in FALLBACK] or self.keys  # an actor's rate alone does not tell
            rates = [read_key(run, key) for key in keys]
            return SCHEDULES[any(isinstance(rate, str) and rate.startswith("lin_") for rate in rates)]
        if self.sets:
            by_size = sorted(self.sets.items(), key=lambda item: -len(item[1]))
            fits = (label for label, s in by_size if all(_same(read_key(run, k), v) for k, v in s.items()))
            return next(fits, None)
        found = [_plain(read_key(run, key)) for key in self.keys]
        return found[0] if found and all(value == found[0] for value in found) else None


Space = tuple[Parameter, ...]


def _same(value: object, wanted: object) -> bool:
    """Whether two values are equal; ``auto_0.4`` (automatic from a start value) counts as ``auto``."""
    value, wanted = (list(x) if isinstance(x, tuple) else x for x in (value, wanted))
    return bool(value == wanted) or (wanted == "auto" and str(value).startswith("auto"))


def _plain(value: object) -> object:
    """The start value of a learning rate ``lin_...``; any other value unchanged."""
    return float(value.removeprefix("lin_")) if isinstance(value, str) and value.startswith("lin_") else value


def read_key(run: RunConfig, key: str) -> object:
    """A configuration's value of a dotted key, or the agent's default if the configuration does not set it."""
    first, *rest = key.split(".")
    value: object = getattr(run, first) if first in RUN else run.model.get(first)
    value = run.env_kwargs.get("subgoals") if first == "subgoals" else value
    for name in rest:
        value = value.get(name) if isinstance(value, Mapping) else None
    if value is None and len(rest) == 1 and first in ("low", "high"):
        value = run.model.get(rest[0])  # of the agent
    if value is not None or _is_set(run.model, key):
        return value
    return read_key(run, FALLBACK[key]) if key in FALLBACK else _default(run.algo, key)


def _default(algo: str, key: str) -> object:
    """An algorithm's default of a dotted key; None if it has no such setting."""
    if algo not in CONFIG_CLASSES:
        return None
    return _written(CONFIG_CLASSES[algo]().to_dict(), key)


# --------------------------------------------------------------------------------------------- reading


def space_file(algo: str) -> Path:
    """The shipped search space of an algorithm.

    :raises ConfigError: if there is none
    """
    folder = Path(str(resources.files("sb3_tbc.zoo_configs"))) / "search"
    path = folder / f"{algo}.yml"
    if not path.is_file():
        raise ConfigError(f"no search space for {algo!r}; {nearest(algo, (p.stem for p in folder.glob('*.yml')))}")
    return path


def read_sections(path: Path) -> dict[str, Plain]:
    """Read a search-space file.

    :raises ConfigError: if it cannot be read or does not consist of sections of parameters
    """
    data = read_yaml(path, SettingsLoader)
    if not isinstance(data, dict) or not all(isinstance(section, dict) for section in data.values()):
        raise ConfigError(f"{path}: expected sections of parameters (default and one per task)")
    return data


def load_space(algo: str, task: str, extra: Path | None = None) -> dict[str, Plain]:
    """The declared space of a search, merged from the shipped file and the user's, default section before task section.

    :param extra: the user's file; a parameter set to ``null`` is not searched
    :return: parameter name -> its fields, plain data that a study can keep
    :raises ConfigError: for a mistake in a file
    """
    merged: Plain = {}
    for path in (space_file(algo), extra):
        sections = read_sections(path) if path is not None else {}
        if path is not None and not sections.keys() & {"default", task}:
            given = ", ".join(sections) or "nothing"
            raise ConfigError(f"{path} needs a section default or one named {task}, it has {given}")
        for name in ("default", task):
            for parameter, fields in sections.get(name, {}).items():
                merged[parameter] = _over(merged.get(parameter), fields)
    space = {name: fields for name, fields in merged.items() if fields is not None}
    for searched in build_space(space):
        if SHARED in {*searched.keys, *(key for settings in searched.sets.values() for key in settings)}:
            raise ConfigError(
                f"search parameter {searched.name}: {SHARED} cannot be searched, because trials are compared after "
                "equal numbers of steps; give --n-timesteps"
            )
    return space


def _over(old: object, new: object) -> object:
    """Update a parameter's fields; a range replaces choices, and choices replace a range."""
    if not isinstance(old, Mapping) or not isinstance(new, Mapping):
        return new
    dropped = ("low", "high", "log", "step") if "choices" in new else ("choices",) if "low" in new else ()
    return {**{key: value for key, value in old.items() if key not in dropped}, **new}


def build_space(declared: Mapping[str, PlainMapping]) -> Space:
    """Parameters from their declaration.

    :raises ConfigError: naming the parameter and what is wrong with it
    """
    space: dict[str, Parameter] = {}
    for name, fields in declared.items():
        parameter = _parameter(name, fields)
        if parameter.when:
            _check_condition(parameter, space)
        space[name] = parameter
    return tuple(space.values())


def _check_condition(parameter: Parameter, above: Mapping[str, Parameter]) -> None:
    """Refuse a condition that nothing can meet: its parameter would never be searched."""
    other, value = parameter.when or ("", None)
    where = f"search parameter {parameter.name}: 'when' must name"
    if other not in above:
        cure = f"take the condition away with {parameter.name}: {{when: null}}"
        raise ConfigError(f"{where} a parameter above it that is searched, got {other!r}; {cure}")
    if not above[other].holds(value):
        raise ConfigError(f"{where} a value that {other} can have, got {value!r}")


def _parameter(name: str, fields: object) -> Parameter:
    where = f"search parameter {name}"
    if not isinstance(fields, Mapping):
        raise ConfigError(f"{where} must have fields like low and high, got {fields!r}")
    for key in fields:
        if key not in FIELDS:
            raise ConfigError(f"{where}: unknown field {key!r}; {nearest(str(key), FIELDS)}")
    keys = fields.get("keys") or ([name] if name != SCHEDULE else list(RATES))
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise ConfigError(f"{where}: keys must be a list of settings, e.g. [low.tau, high.tau], got {keys!r}")
    when = fields.get("when")
    if when is not None and not (isinstance(when, Mapping) and len(when) == 1):
        raise ConfigError(f"{where}: 'when' takes one parameter and its value, got {when!r}")
    condition = next(iter(when.items())) if when else None
    choices = fields.get("choices")
    if choices is not None:
        return _choice(name, tuple(keys), choices, condition, where)
    return _range(name, tuple(keys), fields, condition, where)


def _range(
    name: str, keys: tuple[str, ...], fields: PlainMapping, when: tuple[str, object] | None, where: str
) -> Parameter:
    low, high, log, step = (fields.get(key) for key in ("low", "high", "log", "step"))
    if not _is_number(low) or not _is_number(high) or not low <= high:
        raise ConfigError(f"{where} needs low and high with low <= high, or choices, got {dict(fields)}")
    if not isinstance(log, bool | None):
        raise ConfigError(f"{where}: log must be true or false, got {log!r}")
    if log and low <= 0:
        raise ConfigError(f"{where}: a logarithmic range must begin above 0, got {low}")
    if step is not None and (not _is_number(step) or step <= 0):
        raise ConfigError(f"{where}: step must be a number above 0, got {step!r}; leave it out for none")
    if log and step:
        raise ConfigError(f"{where}: log and step exclude each other")
    low, high = (_end(name, keys, value, where) for value in (low, high))
    parameter = Parameter(name, keys, low, high, bool(log), step, when=when)
    if parameter.whole and step is not None and not float(step).is_integer():
        raise ConfigError(f"{where}: step must be whole where low and high are, got {step}")
    return parameter


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and is_finite(value)


def _end(name: str, keys: tuple[str, ...], value: float, where: str) -> float:
    """An end of a range, checked as a value of its settings; a whole float (``1e5``) as an integer if they all are."""
    if name == SCHEDULE:
        raise ConfigError(f"{where} needs choices, not low and high")
    checked = [_written(validate(nested({key: value}), None, where), key) for key in keys]
    return int(value) if all(isinstance(number, int) for number in checked) else value


def _choice(
    name: str, keys: tuple[str, ...], choices: object, when: tuple[str, object] | None, where: str
) -> Parameter:
    sets = choices if isinstance(choices, Mapping) else {}
    labels = tuple(choices) if isinstance(choices, Mapping | list) else ()
    if not labels or not all(isinstance(label, str | int | float | bool) for label in labels):
        raise ConfigError(
            f"{where}: choices must be a list of values, or labels with the settings they stand for, got {choices!r}"
        )
    if name == SCHEDULE and not set(labels) <= set(SCHEDULES):
        raise ConfigError(f"{where} must be among {', '.join(SCHEDULES)}, got {list(labels)}")
    if name == SCHEDULE and not set(keys) <= set(RATES):
        raise ConfigError(f"{where}: keys must be among {', '.join(RATES)}, got {list(keys)}")
    parameter = Parameter(name, keys, choices=labels, sets={k: dict(v or {}) for k, v in sets.items()}, when=when)
    for label in labels:
        _check_keys(parameter, label, where)
    return parameter


def _check_keys(parameter: Parameter, value: Label, where: str) -> None:
    if parameter.name != SCHEDULE:
        validate(nested(parameter.settings(value)), None, where)


def restrict(
    declared: Mapping[str, PlainMapping], run: RunConfig, patterns: Iterable[str], fixed: PlainMapping
) -> dict[str, Plain]:
    """Leave out parameters that are not searched or have no effect.

    :param declared: the whole space
    :param run: configuration that gives all other settings
    :param patterns: names to search, with ``*`` and ``?``; none for all
    :param fixed: settings of the command line (nested), which are not searched
    :raises ConfigError: if a pattern matches nothing, or nothing is left
    """
    wanted = list(patterns)
    for pattern in wanted:
        if not fnmatch.filter(declared, pattern):
            raise ConfigError(f"--search {pattern!r} matches no parameter; {nearest(pattern, declared)}")
    space = {p.name: p for p in build_space(declared)}
    idle = _idle_keys(run)
    searched = {key for p in space.values() if p.name != SCHEDULE and _is_wanted(p.name, wanted) for key in p.keys}
    left: dict[str, Plain] = {}
    for name, parameter in space.items():
        keys = tuple(key for key in parameter.keys if not _is_set(fixed, key))
        if name == SCHEDULE:
            keys = tuple(key for key in keys if key in searched or not _follows_another(run, key))
        without = (parameter.keys and not keys) or any(_is_set(fixed, k) for s in parameter.sets.values() for k in s)
        if without or not _is_wanted(name, wanted):
            continue
        if any(key.startswith(idle) for key in (*keys, *(k for s in parameter.sets.values() for k in s))):
            continue
        fields = dict(declared[name])
        if parameter.when and parameter.when[0] not in left:
            if space[parameter.when[0]].read(run) != parameter.when[1]:
                continue
            del fields["when"]
        left[name] = {**fields, **({"keys": list(keys)} if parameter.keys else {})}
    if not left:
        raise ConfigError("nothing is left to search: --search and --hyperparams leave out every parameter")
    return left


def _is_wanted(name: str, patterns: Sequence[str]) -> bool:
    return not patterns or any(fnmatch.fnmatch(name, pattern) for pattern in patterns)


def _idle_keys(run: RunConfig) -> tuple[str, ...]:
    """Prefixes of keys without effect: a circuit's if there is none, ``kappa`` if the rule is not used."""
    idle = [] if read_key(run, CIRCUIT) is not None else [CIRCUIT]
    if read_key(run, "duration") != "rule" and not read_key(run, "duration_loss_coef"):
        idle.append("kappa")
    return tuple(idle)


def _follows_another(run: RunConfig, key: str) -> bool:
    """Whether a setting is not set, so that it has the value of another, see :data:`FALLBACK`."""
    return key in FALLBACK and _written(run.model, key) is None


def _written(settings: PlainMapping, key: str) -> object:
    """The value that nested settings give to a dotted key, None if they do not set it."""
    value: object = settings
    for name in key.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _is_set(settings: PlainMapping, key: str) -> bool:
    value: object = settings
    for name in key.split("."):
        if not isinstance(value, Mapping) or name not in value:
            return False
        value = value[name]
    return True


# --------------------------------------------------------------------------------------------- using


def suggest(space: Space, trial: Suggests, only: Iterable[str] | None = None) -> Values:
    """Let a trial choose every parameter whose condition holds.

    :param only: names to choose; by default all
    """
    allowed = None if only is None else set(only)
    values: Values = {}
    for parameter in space:
        if parameter.when and values.get(parameter.when[0]) != parameter.when[1]:
            continue
        if allowed is None or parameter.name in allowed:
            values[parameter.name] = parameter.suggest(trial)
    return values


def project(space: Space, run: RunConfig) -> Values:
    """Express a configuration by values of the space; values outside their range are left out."""
    values: Values = {}
    for parameter in space:
        if parameter.when and values.get(parameter.when[0]) != parameter.when[1]:
            continue
        value = parameter.read(run)
        if value is not None and parameter.holds(value):
            values[parameter.name] = int(value) if parameter.whole and not parameter.choices else value
    return values


def apply(space: Space, values: PlainMapping, run: RunConfig) -> RunConfig:
    """A configuration updated with a trial's values.

    :raises ConfigError: if a value is of the wrong kind
    """
    settings: Values = {}
    for parameter in space:
        if parameter.name in values and parameter.name != SCHEDULE:
            settings.update(parameter.settings(values[parameter.name]))
    for key in next((parameter.keys for parameter in space if parameter.name == SCHEDULE), ()):
        if SCHEDULE in values and (key in settings or not _follows_another(run, key)):
            rate = _plain(settings.get(key, read_key(run, key)))
            settings[key] = f"lin_{rate!r}" if values[SCHEDULE] == "linear" else rate
    return changed(run, validate(nested(settings), run.algo, "trial"), "the search space")


def complete(run: RunConfig, action_dim: int) -> RunConfig:
    """A configuration with all settings of the circuit, also those that the agent would take from its defaults.

    The configuration of a task without a section has no circuit. A trial that set a single size would otherwise leave
    out the others.

    :param action_dim: size of the task's actions, which is the default number of motor neurons
    """
    circuit = read_key(run, CIRCUIT)
    if not isinstance(circuit, Mapping):
        return run
    written = CircuitConfig.from_dict({**circuit, "motor": circuit.get("motor") or action_dim}).to_dict()
    return replace(run, model=merge(run.model, {"low": {"policy_kwargs": {"ndbc": written}}}))

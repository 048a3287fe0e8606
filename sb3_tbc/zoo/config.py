"""Reading configurations: default -> task -> tuned -> command line, merged deeply, checked, never evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib import resources
from pathlib import Path

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.outside import one_line
from sb3_tbc.reading import MAX_DEPTH, SettingsLoader, parse_yaml, read_yaml
from sb3_tbc.settings import merge
from sb3_tbc.tbc_hrl.config import TBCConfig
from sb3_tbc.zoo.schema import RUN, validate

CONFIGS = ("paper", "tuned")
OF_PAPER = "-paper"
"""Ends the names of variants that have the values of the paper's tables."""
N_EVAL_EPISODES = 20
"""Episodes of each evaluation along the curve, where nothing else is said."""
OTHER = "other"
"""Section of configuration files for environments that have none of their own."""
PARTS: dict[str, tuple[Plain, Plain]] = {
    "duration-loss": ({"duration": "joint", "duration_loss_coef": 1.0}, {"duration_loss_coef": 0.0}),
    "rule": ({"duration": "rule", "duration_loss_coef": 0.0}, {"duration": "joint"}),
    "memory": ({"memory": "window", "sequence_length": 4}, {"memory": "none", "sequence_length": 1}),
    "early-end": ({"window_end": "reached"}, {"window_end": "timed"}),
    "smdp": ({"target": "smdp"}, {"target": "decision", "completion_bonus": 0.0}),
    "normalised-critics": (
        {"high": {"critic_norm": "batch"}, "low": {"critic_norm": "batch"}},
        {"high": {"critic_norm": "none"}, "low": {"critic_norm": "none"}},
    ),
    "originals": ({"keep_original": True}, {"keep_original": False}),
    "deterministic-testing": ({"deterministic_testing": True}, {"deterministic_testing": False}),
    "dense-reward": ({"low_reward": "dense"}, {"low_reward": "sparse"}),
    "hindsight-cuts": ({"n_hindsight_cuts": 5}, {"n_hindsight_cuts": 0, "hindsight_cuts_fraction": 1.0}),
}
"""Part of the method -> the settings with it, and those without it; all but the last are of the paper.

The paper normalises the states that critics see; the nearest setting normalises the input of every layer of theirs.
"""
ABLATIONS: dict[str, Plain] = {
    "no-ts": {
        "duration": "fixed",
        "remaining_time": False,
        "target": "decision",
        "duration_loss_coef": 0.0,
        "completion_bonus": 0.0,
    },
    "no-ndbc": {"low": {"policy_kwargs": {"ndbc": None}}, "sequence_length": 1},
    **{f"with-{part}": settings for part, (settings, _) in PARTS.items()},
    **{f"no-{part}": settings for part, (_, settings) in PARTS.items()},
}
"""Ablation name -> what it overrides, merged after the task's section.

``no-ts`` takes timed scheduling out: windows of a constant length (``dt_max``), no remaining time for the low level to
see, one discount per decision in place of ``gamma ** tau``. ``no-ndbc`` gives the low level an MLP. The others put one
of :data:`PARTS` in or leave it out. All keep the full model's number of parameters, see :mod:`sb3_tbc.zoo.ablations`.
A ``tuned`` section may hold a section of an ablation's name: what a search of its own found for it.
"""


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run, except its seed.

    :param algo: algorithm, e.g. ``tbc-hrl``
    :param task: short task name or environment id
    :param config: ``paper`` (the tables' values) or ``tuned``
    :param n_timesteps: environment steps
    :param n_envs: parallel environments
    :param env_kwargs: arguments of ``gymnasium.make``
    :param model: arguments of the algorithm's constructor
    """

    algo: str
    task: str
    config: str
    n_timesteps: int
    n_envs: int = 1
    env_kwargs: Plain = field(default_factory=dict)
    model: Plain = field(default_factory=dict)

    def to_dict(self) -> Plain:
        """Return plain data for ``config.yml``."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: PlainMapping) -> RunConfig:
        """Build the configuration from the data of ``config.yml``.

        :raises ConfigError: if keys are missing or unknown
        """
        try:
            return cls(**data)
        except TypeError as error:
            raise ConfigError(f"not a run's config.yml: {error}") from error


def default_eval_freq(n_timesteps: int) -> int:
    """Environment steps between two evaluations of a run of ``n_timesteps``, where nothing else is said."""
    return max(n_timesteps // 40, 500)


def nested(settings: PlainMapping) -> Plain:
    """``{"low.tau": 1}`` as ``{"low": {"tau": 1}}``."""
    result: Plain = {}
    for key, value in settings.items():
        for name in reversed(key.split(".")):
            value = {name: value}
        result = merge(result, value)
    return result


def config_file(algo: str) -> Path:
    """The shipped configuration file of an algorithm.

    :raises ConfigError: if there is none
    """
    folder = Path(str(resources.files("sb3_tbc.zoo_configs")))
    path = folder / f"{algo}.yml"
    if not path.is_file():
        raise ConfigError(
            f"no configuration for algorithm {algo!r}; {nearest(algo, (p.stem for p in folder.glob('*.yml')))}"
        )
    return path


def read_file(path: Path, algo: str | None = None) -> dict[str, Plain]:
    """Read a configuration file and check all its sections.

    :param algo: algorithm whose settings they are; None allows those of any
    :raises ConfigError: if it cannot be read or holds an unknown key or a wrong value
    """
    data = read_yaml(path, SettingsLoader)
    if not isinstance(data, dict) or not all(isinstance(section, dict) for section in data.values()):
        raise ConfigError(f"{path}: expected sections of keys (default and one per task)")
    return {name: _checked(section, algo, f"{path.name}, section {name}") for name, section in data.items()}


def _checked(section: Plain, algo: str | None, where: str, inner: Sequence[str] = ("tuned",)) -> Plain:
    """Check a section and those inside it: ``tuned``, and in there those of ablations."""
    if not isinstance(section, dict):
        raise ConfigError(f"{where} must be a section of keys, got {one_line(repr(section))}")
    within = {name: section[name] or {} for name in inner if name in section}
    checked = validate({key: value for key, value in section.items() if key not in within}, algo, where)
    ablations = tuple(ABLATIONS) if "tuned" in inner else ()
    return {**checked, **{name: _checked(part, algo, f"{where}, {name}", ablations) for name, part in within.items()}}


def parse_overrides(items: Sequence[str]) -> Plain:
    """Command-line settings: ``["low.learning_rate:1e-3"]`` gives ``{"low": {"learning_rate": 0.001}}``.

    Whether the algorithm has such a setting is checked by :func:`load_config`, which knows the algorithm.

    :raises ConfigError: for a malformed item, an unknown key or a value of the wrong kind
    """
    result: Plain = {}
    for item in items:
        name, separator, text = item.partition(":")
        if not separator or not name:
            raise ConfigError(
                f"--hyperparams takes key:value with dots for sections, e.g. low.gamma:0.98; got {item!r}"
            )
        if name.count(".") > MAX_DEPTH:
            raise ConfigError(f"--hyperparams {one_line(item)!r}: more than {MAX_DEPTH} sections in one another")
        value = parse_yaml(text, f"the value of --hyperparams {one_line(item)!r}", SettingsLoader)
        result = merge(result, nested({name: value}))
    return validate(result, None, "--hyperparams")


def load_config(
    algo: str,
    task: str,
    config: str | None = None,
    overrides: PlainMapping | None = None,
    ablation: str | None = None,
    path: Path | None = None,
) -> RunConfig:
    """The configuration of one run.

    :param algo: algorithm name, which is also the name of the shipped file
    :param task: section to use; an environment without a section of its own takes the one named ``other``
    :param config: ``paper``, ``tuned``, or ``None`` for ``tuned`` if there is such a sub-section, else ``paper``
    :param overrides: settings of the command line, from :func:`parse_overrides`
    :param ablation: name of an ablation
    :param path: another configuration file
    :raises ConfigError: for unknown names and wrong values
    """
    path = path or config_file(algo)
    sections = read_file(path, algo)
    default, section = dict(sections.get("default", {})), dict(sections.get(task, sections.get(OTHER, {})))
    tuned = merge(default.pop("tuned", {}), section.pop("tuned", {}))
    own = {name: tuned.pop(name) for name in ABLATIONS if name in tuned}
    config = config or ("tuned" if tuned else "paper")
    if config not in CONFIGS:
        raise ConfigError(f"configuration must be one of {', '.join(CONFIGS)}, got {config!r}")
    if ablation is not None and ablation not in ABLATIONS:
        raise ConfigError(f"no ablation {ablation!r}; {nearest(ablation, ABLATIONS)}")
    if ablation is not None and algo != "tbc-hrl":
        raise ConfigError(f"only tbc-hrl has ablations, not {algo!r}")
    merged = merge(default, section)
    given = validate(overrides or {}, algo, f"--hyperparams for {algo}")
    changes = [ABLATIONS.get(ablation or "", {}), given]
    if config == "tuned":
        changes = [tuned, changes[0], own.get(ablation or "", {}), given]
    for change in changes:
        merged = merge(merged, change)
    if "n_timesteps" not in merged:
        raise ConfigError(
            f"neither section {task} nor section default of {path} gives n_timesteps; your file replaces the shipped "
            "one as a whole, so start from a copy of that"
        )
    return _run_of(RunConfig(algo, task, config, 0), merged, f"--hyperparams or in {path}")


def changed(run: RunConfig, change: PlainMapping, where: str) -> RunConfig:
    """A configuration with other settings.

    :param change: as a section of a file, merged into the present settings
    :param where: where the change was found, for messages
    :raises ConfigError: if the number of steps is null
    """
    env_kwargs = dict(run.env_kwargs)
    of_run = {"n_timesteps": run.n_timesteps, "n_envs": run.n_envs, "env_kwargs": env_kwargs}
    present = {**run.model, "subgoals": env_kwargs.pop("subgoals", None), **of_run}
    return _run_of(run, merge(present, change), where)


def _run_of(run: RunConfig, settings: Plain, where: str) -> RunConfig:
    """The run of settings that are complete; null stands for a key's default, as it does for a setting.

    Subgoals belong to the environment, and stay with it in a saved agent.

    :raises ConfigError: if the number of steps is null, which has no default
    """
    model = dict(settings)
    subgoals = model.pop("subgoals", None)
    kept = {key: value for key in RUN if (value := model.pop(key, None)) is not None}
    if "n_timesteps" not in kept:
        raise ConfigError(
            f"n_timesteps must be a number of environment steps, got null in {where}; leave it out there to have the "
            "task's"
        )
    if subgoals:
        kept["env_kwargs"] = {**kept.get("env_kwargs", {}), "subgoals": subgoals}
    return RunConfig(run.algo, run.task, run.config, model=model, **kept)


def ablations_of(task: str, config: str | None = None) -> list[str]:
    """The ablations that change something in the configuration of a task.

    :param config: ``paper`` or ``tuned``, as :func:`load_config` takes it
    """

    def settings(ablation: str | None = None) -> TBCConfig:
        model = load_config("tbc-hrl", task, config, ablation=ablation).model
        return TBCConfig.from_dict({name: value for name, value in model.items() if name != "policy"})

    return [name for name in ABLATIONS if settings(name) != settings()]

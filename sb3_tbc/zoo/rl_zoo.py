"""TBC-HRL, HiTS and HAC in RL Baselines3 Zoo: train, continue, enjoy, optimise and plot with its own commands."""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any

from sb3_tbc.aliases import Env, Plain, PlainMapping
from sb3_tbc.commands import run_command
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import require
from sb3_tbc.tasks.generic import DescribedGoalEnv
from sb3_tbc.tbc_hrl import HAC, TBCHRL, HiTS
from sb3_tbc.zoo.config import OTHER, config_file, load_config, read_file
from sb3_tbc.zoo.environments import task_names

IN_ZOO = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC}
"""Algorithms under the names that the zoo's ``--algo`` takes; its own ``sac`` stays what it is."""
COMMANDS = ("train", "enjoy", "plot_train", "plot_from_file", "all_plots")


class DottedSettings:
    """Takes settings of a level by dotted names, as the zoo's ``--hyperparams low.learning_rate:0.001`` gives them."""

    def __init__(self, *args: object, **settings: object) -> None:
        super().__init__(*args, **nested(settings))

    @classmethod
    def load(cls, *args: object, **settings: object) -> object:
        """Load an agent, see :meth:`.TBCHRL.load`."""
        return super().load(*args, **nested(settings))  # type: ignore[misc]


def nested(settings: PlainMapping) -> Plain:
    """Settings with those of dotted names put into their sections.

    :param settings: ``{"low": {...}, "low.gamma": 0.9}``
    """
    result = {name: value for name, value in settings.items() if "." not in name}
    for name, value in settings.items():
        section, dot, key = name.partition(".")
        if dot:
            result[section] = nested({**(result.get(section) or {}), key: value})
    return result


def with_subgoals(env: Env) -> Env:
    """The zoo's ``env_wrapper``: a goal environment of others gets a subgoal space."""
    return env if hasattr(env.unwrapped, "subgoals") else DescribedGoalEnv(env)


def zoo_settings(algo: str) -> dict[str, Plain]:
    """What the zoo's configuration files hold of an algorithm: a section for each of our tasks, and one for others."""
    sections = {"default": _section(algo, OTHER)}
    for task, env_id in task_names().items():
        if task in read_file(config_file(algo), algo):
            sections[env_id] = _section(algo, task)
    return sections


def _section(algo: str, task: str) -> Plain:
    run = load_config(algo, task)
    section: Plain = {"n_timesteps": run.n_timesteps, "n_envs": run.n_envs, **run.model}
    if run.env_kwargs:
        section["env_kwargs"] = run.env_kwargs
    return {"policy": "MultiInputPolicy", "env_wrapper": f"{__name__}.{with_subgoals.__name__}", **section}


def sample_settings(trial: Any, n_actions: int, n_envs: int, more: Plain) -> Plain:
    """A trial of the zoo's ``--optimize-hyperparameters``; ``python -m sb3_tbc.tune`` searches further.

    :param trial: Optuna's
    :param n_actions: not used, as the other parameters
    """
    chosen: Plain = {}
    for level in ("low", "high"):
        chosen[f"{level}.learning_rate"] = trial.suggest_float(f"{level}.learning_rate", 1e-4, 1e-2, log=True)
        chosen[f"{level}.tau"] = trial.suggest_float(f"{level}.tau", 0.002, 0.05, log=True)
    chosen["low.gamma"] = trial.suggest_float("low.gamma", 0.9, 0.99)
    chosen["gradient_ratio"] = trial.suggest_float("gradient_ratio", 0.05, 1.0, log=True)
    chosen["testing_fraction"] = trial.suggest_float("testing_fraction", 0.0, 0.4)
    return chosen


def register() -> None:
    """Make the algorithms known to ``rl_zoo3``; its commands then take ``--algo tbc-hrl``, ``hits`` or ``hac``.

    Without ``--conf-file`` they read the configurations of this package. Calling it again changes nothing.

    :raises MissingExtraError: if rl_zoo3 is not installed
    """
    require("rl_zoo3", extra="zoo", what="RL Baselines3 Zoo")
    utils, manager, search = (
        importlib.import_module(f"rl_zoo3.{name}") for name in ("utils", "exp_manager", "hyperparams_opt")
    )
    for name, algorithm in IN_ZOO.items():
        utils.ALGOS[name] = type(algorithm.__name__, (DottedSettings, algorithm), {"__module__": __name__})
        search.HYPERPARAMS_SAMPLER[name] = sample_settings
        search.HYPERPARAMS_CONVERTER[name] = dict
    reading = manager.ExperimentManager.read_hyperparameters
    if not hasattr(reading, "reads_ours"):
        manager.ExperimentManager.read_hyperparameters = _reading_ours(reading)


def _reading_ours(reading: Callable[[Any], tuple[Plain, Plain]]) -> Callable[[Any], tuple[Plain, Plain]]:
    """The zoo's way of reading configurations, told where ours are."""

    def read_hyperparameters(self: Any) -> tuple[Plain, Plain]:
        if self.algo not in IN_ZOO:
            return reading(self)
        if self.config.endswith(f"hyperparams/{self.algo}.yml"):  # the zoo's own, which there is none of
            module = types.ModuleType(f"{__name__}.{self.algo}")  # it also reads modules
            module.hyperparams = zoo_settings(self.algo)  # type: ignore[attr-defined]
            sys.modules[module.__name__] = module
            self.config = module.__name__
        settings = reading(self)
        if not self.eval_env_kwargs:  # the zoo gives them to training alone
            self.eval_env_kwargs = dict(settings[0].get("env_kwargs", {}))
        return settings

    read_hyperparameters.reads_ours = True  # type: ignore[attr-defined]
    return read_hyperparameters


def command(argv: Sequence[str]) -> int:
    """Run a command of the zoo, which reads the process's arguments itself.

    :param argv: begins with the command's name
    :raises ConfigError: for an unknown command, without rl_zoo3, or for settings that an agent refuses
    """
    if not argv or argv[0] not in COMMANDS:
        raise ConfigError(f"give a command of the zoo: {', '.join(COMMANDS)}")
    register()
    importlib.import_module("rl_zoo3.cli").main()
    return 0


def main() -> int:
    """``python -m sb3_tbc.zoo.rl_zoo train --algo hits --env sb3_tbc/Pendulum-v0``: the zoo's commands with ours in it.

    :return: exit status
    """
    return run_command(command, "sb3_tbc.zoo.rl_zoo")


if __name__ == "__main__":
    from sb3_tbc.zoo.rl_zoo import main as run  # under its own name: the zoo keeps what it is told

    sys.exit(run())

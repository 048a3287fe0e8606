"""Finds the class of an algorithm by name, and loads agents from ``.zip`` files with clear error messages."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path
from typing import TypedDict, Unpack

from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.outside import one_line
from sb3_tbc.tasks.foreign import ROBOTICS
from sb3_tbc.tbc_hrl import HAC, TBCHRL, HiTS
from sb3_tbc.tbc_hrl.archive import UntrustedError, read_bytes, read_data
from sb3_tbc.tbc_hrl.environment import episode_length
from sb3_tbc.tbc_hrl.evaluation import Agent
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.zoo.config import RunConfig

ALGORITHMS: dict[str, type[TBCHRL] | type[FlatSAC]] = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC, "sac": FlatSAC}
RUN_INFO = "run_info"
"""Attribute, and key in the ``.zip``, that describe a run: task, environment, variant, seed."""


def algorithm(name: str) -> type[TBCHRL] | type[FlatSAC]:
    """The class of an algorithm.

    :raises ConfigError: naming the nearest known one
    """
    if name not in ALGORITHMS:
        raise ConfigError(f"unknown algorithm {name!r}; {nearest(name, ALGORITHMS)}")
    return ALGORITHMS[name]


class BuildOptions(TypedDict, total=False):
    """Arguments of an agent's constructor that are not settings."""

    device: str
    verbose: int
    tensorboard_log: str | None


def build_model(run: RunConfig, env: VecEnv, seed: int, **options: Unpack[BuildOptions]) -> Agent:
    """Build the agent of a configuration.

    :param run: what to build
    :param env: training environments
    :param seed: seed of the networks, of sampling and of the environments
    :param options: see :class:`BuildOptions`
    :raises ConfigError: if the agent refuses a setting or the environment, or flat SAC is to learn without a time limit
    """
    settings = dict(run.model)
    policy = settings.pop("policy", "MultiInputPolicy")
    kind = algorithm(run.algo)
    if kind is FlatSAC and episode_length(env) is None:  # two levels end an episode when their decisions are used up
        raise ConfigError(
            f"{run.algo} on {run.task}: its episodes have no time limit, so that training and evaluations might wait "
            "for their end for ever; give one: --hyperparams env_kwargs.max_episode_steps:N"
        )
    try:
        return kind(policy, env, seed=seed, **settings, **options)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{run.algo} on {run.task}: {error}") from error
    except (MemoryError, OverflowError) as error:
        raise ConfigError(
            f"{run.algo} on {run.task} does not fit into memory ({error}); a smaller buffer_size usually cures it"
        ) from error


def read_zip(path: Path) -> Plain:
    """The plain data of an agent's ``.zip``, read without unpickling anything.

    :raises ConfigError: if the file is missing, truncated, or not an agent of SB3's format
    """
    if os.path.isdir(path):  # a name that is too long, or a folder that is not ours, is told when it is read
        raise ConfigError(f"{path} is a folder, not an agent's .zip; {_inside(path)}")
    return read_data(read_bytes(path), str(path))


def _inside(folder: Path) -> str:
    """The part of a message that names the agent inside a folder, if there is one."""
    found = sorted(folder.rglob("model.zip"), key=lambda p: (p.parent.name == "checkpoint", p))
    found = found or sorted(folder.rglob("*.zip"))
    if not found:
        return "there is no .zip inside it"
    more = f" (and {len(found) - 1} more inside it)" if len(found) > 1 else ""
    return f"did you mean {found[0]}?{more}"


def environment_of(path: Path, data: Plain, trust: bool = False) -> tuple[str, Plain]:
    """Id and arguments of the environment on which an agent was trained, as its ``.zip`` gives them.

    :param path: file of the agent, for messages
    :param data: result of :func:`read_zip`
    :param trust: whether a module that the agent names may be imported
    :raises UntrustedError: if the id names a module, other than Gymnasium-Robotics, that would be imported
    :raises ConfigError: if it names none, or what it names is not an environment
    """
    info = data.get(RUN_INFO)
    info = info if isinstance(info, dict) else {}
    env_id, env_kwargs = info.get("env_id"), info.get("env_kwargs", {})
    if env_id is None:
        raise ConfigError(f"{path} does not say on which environment it was trained; pass --env")
    if not isinstance(env_kwargs, dict):
        raise ConfigError(
            f"{path} does not give its environment's arguments as plain data but as {one_line(env_kwargs)!r}; pass "
            "--env, and --trust if you trust the file, to use the environment with its defaults"
        )
    if not isinstance(env_id, str):
        raise ConfigError(f"{path} gives {one_line(env_id)!r} where the id of an environment is expected; pass --env")
    module = env_id.rpartition(":")[0]
    if module and not trust and module != ROBOTICS and module not in sys.modules:
        raise UntrustedError(
            f"{path} asks to import the module {one_line(module)!r} for its environment, which can run any code; if "
            f"you trust it, pass --env {shlex.quote(one_line(env_id))} or --trust"
        )
    return env_id, env_kwargs


FLAT = ("stable_baselines3.sac.policies", "sb3_tbc.tbc_hrl.averaged_policy")
"""Where the policies of flat SAC are."""


def algorithm_of(path: Path, data: Plain) -> str:
    """Which algorithm an agent's ``.zip`` belongs to.

    :raises ConfigError: if it is not one of ours
    """
    info, policy = data.get(RUN_INFO), data.get("policy_class")
    name = info.get("algo") if isinstance(info, dict) else None
    if isinstance(name, str) and name in ALGORITHMS:
        return name
    origin = policy.get("__module__") if isinstance(policy, dict) else None
    given = data.get("settings")  # SB3's own agents have none
    if name is None and isinstance(given, dict) and "low" not in given and str(origin) in FLAT:
        return "sac"
    if name is None and str(origin).startswith("sb3_tbc.tbc_hrl"):  # saved by model.save, without the runner
        settings = data.get("settings", data)  # version 0.1.0 kept them among its other attributes
        if settings.get("low_reward") == "step":
            return "hac"
        return "hits" if settings.get("target") == "decision" else "tbc-hrl"
    raise ConfigError(
        f"{path} holds an agent of another algorithm ({one_line(name or origin or 'unknown')}); this takes agents of "
        f"{', '.join(ALGORITHMS)} that this package has trained. Load others with the class that saved them, and "
        "measure them with SB3's evaluate_policy"
    )


def observation_size(data: Plain) -> int | None:
    """Size of the ``observation`` on which an agent acts, read from its ``.zip``; None if it is not given there."""
    space = data.get("observation_space")
    described = str(space.get("spaces")) if isinstance(space, dict) else ""
    found = re.search(r"'observation': Box\([^()]*\((\d+),\)", described)
    return None if found is None else int(found[1])


def load_model(path: Path, env: VecEnv | None = None, device: str = "cpu", trust: bool = False) -> Agent:
    """Load an agent of any of our algorithms.

    :param path: the ``.zip``
    :param env: environments to learn in; to act an agent needs none
    :param device: torch device
    :param trust: whether code from the file may run, see :meth:`.PlainAlgorithm.load`
    :raises UntrustedError: if it cannot be loaded without that
    :raises ConfigError: if it cannot be loaded
    """
    name = algorithm_of(path, read_zip(path))
    try:
        return ALGORITHMS[name].load(path, env=env, device=device, trust=trust)
    except ConfigError:
        raise
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"cannot load {path} as {name}: {one_line(error, 1000)}") from error
    except Exception as error:  # a stranger's file can be wrong in any way
        raise ConfigError(f"cannot load {path} as {name}: {type(error).__name__}: {one_line(error)}") from error


def load_two_levels(path: Path, device: str = "cpu", trust: bool = False) -> TBCHRL:
    """Load an agent that has subgoals.

    :raises ConfigError: if it cannot be loaded or has only one level
    """
    model = load_model(path, None, device, trust)
    if not isinstance(model, TBCHRL):
        raise ConfigError(f"{path} holds a flat agent; this command needs one with two levels")
    return model

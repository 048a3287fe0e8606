"""From an algorithm's name to its class, and from a ``.zip`` to an agent, with clear refusals."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.tbc_hrl import HAC, TBCHRL, HiTS
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.zoo.config import RunConfig
from sb3_tbc.zoo.environments import make_envs

Agent = TBCHRL | FlatSAC
ALGORITHMS: dict[str, type[TBCHRL] | type[FlatSAC]] = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC, "sac": FlatSAC}
RUN_INFO = "run_info"
"""Attribute, and key in the ``.zip``, with what the runner knows of a run: task, environment, variant, seed."""


def algorithm(name: str) -> type[TBCHRL] | type[FlatSAC]:
    """The class of an algorithm.

    :raises ConfigError: naming the nearest known one
    """
    if name not in ALGORITHMS:
        raise ConfigError(f"unknown algorithm {name!r}; {nearest(name, ALGORITHMS)}")
    return ALGORITHMS[name]


def build_model(run: RunConfig, env: VecEnv, seed: int, **options: Any) -> Agent:
    """Build the agent of a configuration.

    :param run: what to build
    :param env: training environments
    :param seed: of networks, sampling and environments
    :param options: ``device``, ``verbose``, ``tensorboard_log``
    :raises ConfigError: if the agent refuses a setting or the environment
    """
    settings = dict(run.model)
    policy = settings.pop("policy", "MultiInputPolicy")
    try:
        return algorithm(run.algo)(policy, env, seed=seed, **settings, **options)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{run.algo} on {run.task}: {error}") from error
    except (MemoryError, OverflowError) as error:
        raise ConfigError(
            f"{run.algo} on {run.task} does not fit into memory ({error}); a smaller buffer_size usually cures it"
        ) from error


def read_zip(path: Path) -> dict[str, Any]:
    """The plain data of an agent's ``.zip``, read without unpickling anything.

    :raises ConfigError: if the file is missing, truncated, or not an agent of SB3's format
    """
    if path.is_dir():
        raise ConfigError(f"{path} is a folder, not an agent's .zip; {_inside(path)}")
    if not path.is_file():
        raise ConfigError(f"no such file: {path} (an agent is saved as .zip by train or model.save)")
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
            data = json.loads(archive.read("data"))
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError) as error:
        raise ConfigError(f"{path} is not a complete agent .zip (truncated or another format): {error}") from error
    if broken is not None:
        raise ConfigError(f"{path} is damaged: {broken} fails its checksum")
    if not isinstance(data, dict):
        raise ConfigError(f"{path} is not an agent .zip: its data is no table")
    return data


def _inside(folder: Path) -> str:
    """What to give instead of a folder: the agent in it, where there is one."""
    found = sorted(folder.rglob("model.zip"), key=lambda p: (p.parent.name == "checkpoint", p))
    found = found or sorted(folder.rglob("*.zip"))
    if not found:
        return "there is no .zip inside it"
    more = f" (and {len(found) - 1} more inside it)" if len(found) > 1 else ""
    return f"did you mean {found[0]}?{more}"


def algorithm_of(path: Path, data: dict[str, Any]) -> str:
    """Which algorithm an agent's ``.zip`` belongs to.

    :raises ConfigError: if it is not one of ours
    """
    info, policy = data.get(RUN_INFO), data.get("policy_class")
    name = info.get("algo") if isinstance(info, dict) else None
    if name in ALGORITHMS:
        return str(name)
    origin = policy.get("__module__") if isinstance(policy, dict) else None
    if name is None and str(origin).startswith("sb3_tbc.tbc_hrl"):  # saved by model.save, without the runner
        settings = data.get("settings", data)  # version 0.1.0 kept them among its other attributes
        if settings.get("low_reward") == "step":
            return "hac"
        return "hits" if settings.get("target") == "decision" else "tbc-hrl"
    raise ConfigError(
        f"{path} holds an agent of another algorithm ({name or origin or 'unknown'}), not of {', '.join(ALGORITHMS)}"
    )


def load_model(path: Path, env: VecEnv | None = None, device: str = "cpu") -> Agent:
    """Load an agent of any of our algorithms.

    :param path: the ``.zip``
    :param env: environments to act in; an agent that needs some to be loaded gets those it was trained on
    :param device: torch device
    :raises ConfigError: if it cannot be loaded
    """
    data = read_zip(path)
    name = algorithm_of(path, data)
    try:
        if env is None and ALGORITHMS[name] is FlatSAC:
            env = make_envs(data[RUN_INFO]["env_id"], 1, None, data[RUN_INFO]["env_kwargs"])
        return ALGORITHMS[name].load(path, env=env, device=device)
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        raise ConfigError(f"cannot load {path} as {name}: {error}") from error


def load_two_levels(path: Path, env: VecEnv | None = None, device: str = "cpu") -> TBCHRL:
    """Load an agent that has subgoals.

    :raises ConfigError: if it cannot be loaded or has none
    """
    model = load_model(path, env, device)
    if not isinstance(model, TBCHRL):
        raise ConfigError(f"{path} holds a flat agent, without the two levels that are needed here")
    return model

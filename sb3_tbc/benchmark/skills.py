"""Skills to imitate: recordings of trained low levels, and delays; see :mod:`sb3_tbc.benchmark.fit`."""

from __future__ import annotations

import io
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.arrays import FloatArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.evaluate import identify
from sb3_tbc.files import replacing, require_writable
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.collection import TwoLevelRunner
from sb3_tbc.zoo.algorithms import load_two_levels
from sb3_tbc.zoo.environments import make_envs, resolve_env

MAX_BYTES = 900_000
"""Size of a recording before it is compressed."""
MAX_ROWS = 24_000
DELAYS = (3, 10, 30)
DELAY_STEPS = 50
"""Control steps of a sequence in the delay skills."""


class Skill(NamedTuple):
    """A skill to learn: inputs and standardised targets, ``(rows, n)`` or ``(sequences, time, n)``."""

    name: str
    inputs: th.Tensor
    targets: th.Tensor
    later_inputs: th.Tensor  # for evaluation: rows of later episodes, or other sequences
    later_targets: th.Tensor

    @property
    def n_inputs(self) -> int:
        """Width of the inputs."""
        return int(self.inputs.shape[-1])

    @property
    def n_outputs(self) -> int:
        """Width of the targets."""
        return int(self.targets.shape[-1])


def skill_names() -> list[str]:
    """Tasks that have a recording, and the delays."""
    folder = files("sb3_tbc.benchmark") / "skills"
    recorded = sorted(Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".npz"))
    return [*recorded, *(f"delay{steps}" for steps in DELAYS)]


def load_skill(name: str) -> Skill:
    """A skill by name.

    :param name: a task that has a recording, or ``delay<steps>``
    :raises ConfigError: if there is none of this name
    """
    delay = name.removeprefix("delay")
    if delay != name and delay.isdecimal() and 0 < int(delay) < DELAY_STEPS:
        return delay_skill(int(delay))
    if name not in skill_names():
        raise ConfigError(
            f"no skill {name!r}; there are {', '.join(skill_names())}, and delay1 to delay{DELAY_STEPS - 1}"
        )
    data = (files("sb3_tbc.benchmark") / "skills" / f"{name}.npz").read_bytes()
    with np.load(io.BytesIO(data)) as recording:
        inputs, means = (th.from_numpy(recording[key].astype(np.float32)) for key in ("inputs", "means"))
        cut = int(recording["learnt"])
    targets = (means - means[:cut].mean(dim=0)) / means[:cut].std(dim=0).clamp(min=1e-6)
    return Skill(name, inputs[:cut], targets[:cut], inputs[cut:], targets[cut:])


def delay_skill(steps: int, n_learnt: int = 2048, n_later: int = 256) -> Skill:
    """Repeat the input of ``steps`` control steps ago: uniform numbers in [-1, 1], each held for five steps.

    The first ``steps`` targets of a sequence are zero. Without memory an actor explains
    ``((5 - steps) / 5)^2`` of it, and nothing from five steps on.

    :param steps: the delay
    :param n_learnt: sequences to learn from
    :param n_later: sequences for evaluation
    """
    rng = np.random.default_rng(steps)
    held = rng.uniform(-1.0, 1.0, (n_learnt + n_later, DELAY_STEPS // 5)).repeat(5, axis=1)
    inputs = th.from_numpy(held.astype(np.float32)).unsqueeze(-1)
    targets = th.cat([th.zeros(len(inputs), steps, 1), inputs[:, :-steps]], dim=1)
    return Skill(f"delay{steps}", inputs[:n_learnt], targets[:n_learnt], inputs[n_learnt:], targets[n_learnt:])


def record(model: TBCHRL, env: VecEnv, every: int = 3, seed: int = 0) -> dict[str, FloatArray]:
    """Record the inputs of an agent's low level while both levels act with noise, and the means of its actions.

    :param model: a trained agent whose low level has no memory, so that its rows are independent
    :param env: one environment of the agent's task
    :param every: record every n-th step, because neighbouring steps are very similar
    :param seed: seed of environment and noise
    :return: ``inputs`` divided by the circuit's fixed scales and ``means`` before squashing, float16, and ``learnt``,
        the number of rows to learn from: those of the first 85 % of the episodes
    :raises ConfigError: if the low level remembers
    """
    actor = model.low.policy.average_actor
    if actor.state_dim and model.config.memory != "none":
        raise ConfigError(
            f"the low level of this agent remembers (memory={model.config.memory!r}), so that its inputs alone do not "
            "tell its actions; record an agent with memory='none' or with an MLP"
        )
    runner = TwoLevelRunner(env, model.policy, np.random.default_rng(seed))
    env.seed(seed)
    runner.reset()
    n_inputs, n_means = runner.observation.shape[1], int(np.prod(model.action_space.shape or ()))
    n_rows, rows, ends = min(MAX_ROWS, MAX_BYTES // (2 * (n_inputs + n_means))), [], []
    for step in range(n_rows * every):
        if step % every == 0:
            rows.append(runner.observation[0].astype(np.float32))
        if runner.step().episodes:
            ends.append(len(rows))
    seen = np.stack(rows)
    with th.no_grad():
        means = actor.step(th.from_numpy(seen), th.zeros(len(seen), actor.state_dim))[0].numpy()
    scaled = seen / np.asarray(model.views.low_scale(), dtype=np.float32)
    learnt = max([end for end in ends if end <= 0.85 * n_rows], default=0)
    if not learnt:
        raise ConfigError(f"no episode ended within {n_rows * every} steps: there are no later episodes for evaluation")
    half = {"inputs": scaled.astype(np.float16), "means": means.astype(np.float16)}
    return {**half, "learnt": np.array(learnt)}


def record_file(path: Path, out: Path | None, every: int, env: str | None = None, trust: bool = False) -> Path:
    """Record the agent in a ``.zip`` on its task.

    :param path: the agent
    :param out: where to write; by default where the skills of this package lie, under the task's name
    :param every: see :func:`record`
    :param env: the task, by default the one on which the agent was trained
    :param trust: whether the file may run code
    :return: the file written
    :raises ConfigError: if the agent cannot be loaded, or its file does not name its task
    """
    info = identify(path, env, trust)
    model = load_two_levels(path, trust=trust)
    venv = make_envs(info["env_id"], 1, 0, info["env_kwargs"])
    task, _ = resolve_env(info["env_id"])
    out = out or Path(str(files("sb3_tbc.benchmark") / "skills")) / f"{task}.npz"
    require_writable(out)  # recording takes minutes
    recording = record(model, venv, every)
    venv.close()
    with replacing(out) as temporary:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **recording)  # type: ignore[arg-type]
        temporary.write_bytes(buffer.getvalue())
    return out

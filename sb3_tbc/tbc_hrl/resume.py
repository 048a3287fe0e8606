"""The state of a run besides weights and replay, so that it can be continued bit for bit after an interruption."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import AnyArray, Arrays, put_under, taken_from
from sb3_tbc.level.actors import NDBCActor
from sb3_tbc.level.level import SACLevel
from sb3_tbc.replay.both_levels import Replay
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv, RunningEpisode
from sb3_tbc.tbc_hrl.collection import Collector
from sb3_tbc.tbc_hrl.diagnostics import EpisodeDiagnostics
from sb3_tbc.tbc_hrl.reachability import Reachability

logger = logging.getLogger(__name__)
NOT_KNOWN = "the environments begin new episodes: those that ran when the run was saved were not recorded"
ELSEWHERE = "the environments begin new episodes: replaying the saved ones led to other observations"


class MovingParts(NamedTuple):
    """What changes while an agent learns, besides its settings."""

    num_timesteps: int
    high: SACLevel
    low: SACLevel
    replay: Replay
    policy_rng: np.random.Generator
    rng: np.random.Generator
    reachability: Reachability | None
    diagnostics: EpisodeDiagnostics
    collector: Collector | None


def generators(parts: MovingParts) -> dict[str, np.random.Generator]:
    """Every source of randomness that learning draws from."""
    found = {
        "agent": parts.rng,
        "policy": parts.policy_rng,
        "high.noise": parts.high.noise_rng,
        "low.noise": parts.low.noise_rng,
        "high.replay": parts.replay.high.rng,
        "low.replay": parts.replay.low.rng,
    }
    if parts.reachability is not None:
        found["reachability"] = parts.reachability.rng
    return found


def reseed(parts: MovingParts, seed: int) -> None:
    """Let every source of randomness begin anew."""
    found = generators(parts)
    for generator, child in zip(found.values(), np.random.SeedSequence(seed).spawn(len(found)), strict=True):
        generator.bit_generator.state = np.random.default_rng(child).bit_generator.state


def get_state(parts: MovingParts) -> Arrays:
    """Random streams, counters, live options and running episodes, as plain arrays.

    :param parts: what to take them from
    """
    plain = {
        "timesteps": int(parts.num_timesteps),
        "generators": {name: rng.bit_generator.state for name, rng in generators(parts).items()},
        "n_updates": [parts.high._n_updates, parts.low._n_updates],
        "diagnostics": dict(parts.diagnostics.values),
    }
    arrays: Arrays = {}
    actor = parts.low.policy.actor
    if isinstance(actor, NDBCActor):
        plain["circuit"] = {"updates": actor.net.updates, "sub_steps": actor.net.sub_steps}
        arrays["direction"] = actor.net.lipschitz.direction.numpy().copy()
    if parts.collector is not None and isinstance(parts.collector.env.venv, GoalVecEnv):
        plain["episodes"], actions = _running(parts.collector.env.venv)
        arrays |= actions
        arrays |= put_under("collector", parts.collector.get_state())
    return {**arrays, "plain": np.array(json.dumps(plain))}


def set_state(parts: MovingParts, state: Mapping[str, AnyArray]) -> bool:
    """Restore what :func:`get_state` gave; False, with nothing changed, if the agent was saved at another moment.

    Then the log says that the run continues, but not exactly as the saved one would have. If the environments cannot be
    brought back to their state, everything else is restored and they begin new episodes; the log says that, too.
    """
    plain = _plain(state)
    if plain.get("timesteps") != parts.num_timesteps:
        saved = plain.get("timesteps", "an unknown number of")
        logger.warning(
            f"the replay buffer was saved after {saved} steps, the agent after {parts.num_timesteps}: learning goes "
            "on with that buffer, but with new episodes and other random numbers than the saved run"
        )
        return False
    if parts.collector is not None:
        _relive(parts.collector, plain, state)
    for name, rng in generators(parts).items():
        if name in plain["generators"]:
            rng.bit_generator.state = plain["generators"][name]
    parts.high._n_updates, parts.low._n_updates = plain["n_updates"]
    parts.diagnostics.values.clear()
    parts.diagnostics.values.update(plain["diagnostics"])
    actor = parts.low.policy.actor
    if isinstance(actor, NDBCActor) and "circuit" in plain:
        actor.net.updates, actor.net.sub_steps = plain["circuit"]["updates"], plain["circuit"]["sub_steps"]
        actor.net.lipschitz.direction.copy_(actor.net.lipschitz.direction.new_tensor(state["direction"]))
        parts.low.acting.refresh()
    return True


def _plain(state: Mapping[str, AnyArray]) -> Plain:
    """What a state holds besides arrays; nothing where there is no state."""
    plain: Plain = json.loads(str(state["plain"])) if "plain" in state else {}
    return plain


def _relive(collector: Collector, plain: PlainMapping, state: Mapping[str, AnyArray]) -> None:
    venv, starts = collector.env.venv, plain.get("episodes", [])
    if not isinstance(venv, GoalVecEnv) or len(starts) != venv.num_envs:
        logger.warning(NOT_KNOWN)
        return
    observation = venv.relive(_episodes(starts, state))
    if not collector.set_state(taken_from("collector", state), observation):
        logger.warning(ELSEWHERE)
        collector.reset()


def _running(venv: GoalVecEnv) -> tuple[list[Plain], Arrays]:
    """How the running episodes began, and the actions taken since."""
    starts = [
        {"seed": episode.seed, "generator": episode.generator, "others": list(episode.others)}
        for episode in venv.running
    ]
    return starts, {f"actions.{i}": np.array(episode.actions) for i, episode in enumerate(venv.running)}


def _episodes(starts: list[Plain], state: Mapping[str, AnyArray]) -> list[RunningEpisode]:
    return [RunningEpisode(**start, actions=list(state[f"actions.{i}"])) for i, start in enumerate(starts)]


# -- the flat agent ----------------------------------------------------------------------------------------------------


def get_flat_state(model: OffPolicyAlgorithm) -> Arrays:
    """As :func:`get_state`. SB3's SAC draws from the generators of torch and NumPy that all code shares."""
    _, keys, *rest = np.random.get_state()  # noqa: NPY002 (SB3 draws from it)
    plain: Plain = {
        "timesteps": int(model.num_timesteps),
        "numpy": rest,
        "action_space": model.action_space.np_random.bit_generator.state,
    }
    arrays: Arrays = {"numpy": np.asarray(keys), "torch": th.get_rng_state().numpy()}
    if isinstance(model.env, GoalVecEnv) and isinstance(model._last_obs, dict):
        plain["episodes"], actions = _running(model.env)
        arrays |= actions | put_under("last", {key: np.array(part) for key, part in model._last_obs.items()})
    return {**arrays, "plain": np.array(json.dumps(plain))}


def can_go_on(model: OffPolicyAlgorithm, state: Mapping[str, AnyArray]) -> bool:
    """Whether a saved run's episodes can be continued."""
    plain = _plain(state)
    known = isinstance(model.env, GoalVecEnv) and len(plain.get("episodes", ())) == model.n_envs
    return known and plain["timesteps"] == model.num_timesteps


def set_flat_state(model: OffPolicyAlgorithm, env: VecEnv, state: Mapping[str, AnyArray]) -> bool:
    """Restore what :func:`get_flat_state` gave; False if the saved episodes cannot be continued.

    They were not recorded, or replaying them led to other observations. The environments then begin new episodes, and
    the log says so.
    """
    if not can_go_on(model, state) or not isinstance(env, GoalVecEnv):
        logger.warning(NOT_KNOWN)
        return False
    plain = _plain(state)
    seen = env.relive(_episodes(plain["episodes"], state))
    last = taken_from("last", state)
    if not all(np.array_equal(seen[key], last[key]) for key in seen):
        logger.warning(ELSEWHERE)
        model._last_obs = env.reset()  # type: ignore[assignment]
        return False
    model._last_obs = dict(seen)
    th.set_rng_state(th.from_numpy(state["torch"].copy()))
    np.random.set_state(("MT19937", state["numpy"], *plain["numpy"]))  # noqa: NPY002
    model.action_space.np_random.bit_generator.state = plain["action_space"]
    return True

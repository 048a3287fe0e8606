"""Plugin of pytest: our algorithms and goal environments in Stable-Baselines3's tests, and what comes of it."""

from __future__ import annotations

import collections
import importlib.util
import inspect
import json
import os
import re
import sys
import traceback
import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import stable_baselines3 as sb3
from agents import ours
from goal_envs import AsGoalEnv, Batch, OurNumPy, as_goal_env, goal_spec
from stable_baselines3.common.vec_env import DummyVecEnv
from tests_apart import LEFT_OUT, RANDOM_WEIGHTS, REFUSED, REPLACES, UNTOUCHED

import sb3_tbc
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv

OURS = Path(sb3_tbc.__file__).resolve().parent
SB3 = ("SAC", "TD3", "DDPG", "A2C", "PPO", "DQN")
"""SB3's algorithms: the first that a test uses is replaced, with continuous actions first."""
USED = re.compile(r"\b(A2C|DDPG|DQN|PPO|SAC|TD3|MODEL_LIST|MODEL_DICT|model_class|algo)\b")


UNTOUCHED_WITH = "tbc-hrl"
"""Tests that none of our algorithms takes part in are run once, together with this one."""


def used_by(function: Any) -> set[str]:
    """Names of algorithms in a test's source."""
    return set(USED.findall(inspect.getsource(function)))


def key_of(item: Any) -> str:
    """``file::function`` of a test."""
    return f"{Path(str(item.fspath)).name}::{item.function.__name__}"


def replaced_in(names: set[str]) -> str | None:
    """SB3's algorithm whose place is taken in a test that uses these."""
    if names & {"MODEL_LIST", "MODEL_DICT"}:
        return "SAC"
    return next((name for name in SB3 if name in names), None)


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Keep the tests that use an algorithm, once for each, and put ours into their parameters."""
    items[:] = [item for item in items if _applies(item)]


def _applies(item: Any) -> bool:
    """Whether a case is to be run; if so, it is made ready."""
    key, names = key_of(item), used_by(item.function)
    name = REPLACES.get(key, replaced_in(names))
    if name is None or key in LEFT_OUT:
        return False
    if key in UNTOUCHED:
        return os.environ["SB3_SUITE_ALGO"] == UNTOUCHED_WITH
    original, algorithm = getattr(sb3, name), ours(name, key not in RANDOM_WEIGHTS, key in REFUSED)
    params = item.callspec.params if hasattr(item, "callspec") else {}
    classes = [v for v in params.values() if isinstance(v, type) and v.__module__.startswith("stable_baselines3")]
    if (classes and original not in classes) or params.get("model_name", "sac") != "sac":
        return False
    for argument, value in params.items():
        if value is original:
            params[argument] = algorithm
        elif isinstance(value, gym.Env):
            params[argument] = as_goal_env(value)
    item.replaces = ([name] if classes else names & set(SB3) | {name}, algorithm)
    return True


@pytest.fixture(autouse=True)
def in_our_world(request: Any, monkeypatch: Any) -> None:
    """Put our algorithm, goal environments and their observations into a test's module."""
    if key_of(request.node) not in UNTOUCHED:
        put_in(request.module, *request.node.replaces, monkeypatch)


def put_in(module: Any, names: set[str], algorithm: type[Any], monkeypatch: Any) -> None:
    """The same, for a module.

    :param names: of SB3's algorithms that are replaced
    """
    for name in names:
        for place in (module, getattr(module, "sb3", None)):
            if hasattr(place, name):
                monkeypatch.setattr(place, name, algorithm)
    for attribute, value in list(vars(module).items()):
        if is_task(value):
            monkeypatch.setattr(module, attribute, made_as_goal_env(value))
    if "SubprocVecEnv" in vars(module):
        monkeypatch.setattr(module, "SubprocVecEnv", forked(module.SubprocVecEnv))
    if "MODEL_DICT" in vars(module):
        monkeypatch.setitem(module.MODEL_DICT, "sac", (algorithm, module.MODEL_DICT["sac"][1]))
    if "np" in vars(module):
        monkeypatch.setattr(module, "np", OurNumPy())
    monkeypatch.setattr(AsGoalEnv, "keeps_keys", algorithm.as_given)
    for env_id in ("Pendulum-v1", "MountainCarContinuous-v0", *(() if algorithm.as_given else ("CartPole-v1",))):
        monkeypatch.setitem(gym.registry, env_id, goal_spec(env_id))


def forked(kind: type[Any]) -> type[Any]:
    """``SubprocVecEnv`` whose processes know of the goal environments of this one."""
    return type(
        kind.__name__, (kind,), {"__init__": lambda self, fns, start_method=None: kind.__init__(self, fns, "fork")}
    )


def is_task(value: Any) -> bool:
    """Whether it is a class of environments of the suite."""
    return (
        inspect.isclass(value)
        and issubclass(value, gym.Env)
        and not issubclass(value, gym.Wrapper)
        and value is not gym.Env
    )


def made_as_goal_env(kind: type[Any]) -> Any:
    """A class whose calls give goal environments."""
    return type(kind.__name__, (kind,), {"__new__": lambda _, *args, **kwargs: as_goal_env(kind(*args, **kwargs))})


def pytest_configure(config: Any) -> None:
    """Let vectors of environments give observations that have a shape."""
    if importlib.util.find_spec("ale_py") is None:  # only tests of Atari need it, which do not apply
        sys.modules["ale_py"] = types.ModuleType("ale_py")
    for kind in (DummyVecEnv, GoalVecEnv):
        kind._obs_from_buf = shaped(kind._obs_from_buf)  # type: ignore[method-assign]


def shaped(method: Any) -> Any:
    """A method that gives dictionaries, giving :class:`Batch` instead."""

    def wrapped(self: Any) -> Any:
        observation = method(self)
        return Batch(observation) if isinstance(observation, dict) else observation

    return wrapped


RESULTS: dict[str, list[str]] = collections.defaultdict(list)
WHY: dict[str, str] = {}


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: Any, call: Any) -> Any:
    """Note how each case ends."""
    report = (yield).get_result()
    if call.when == "call" or (call.when == "setup" and report.outcome != "passed"):
        key, ended, why = key_of(item), report.outcome, ""
        if ended == "skipped":
            why = str(report.longrepr)[-300:]
        elif ended == "failed":
            refusal = refused_by(call.excinfo.value) if key in REFUSED else None
            ended = "refused" if refusal else ended
            why = refusal or str(call.excinfo.value)[:300]
        RESULTS[key].append(ended)
        if why:
            WHY[item.nodeid] = f"{ended}: {why}"


def refused_by(error: BaseException | None) -> str | None:
    """The error of ours, of one line, that a test met, be it one that it did not expect; None if there is none."""
    while error is not None:
        frames = traceback.extract_tb(error.__traceback__)
        raised_here = bool(frames) and OURS in Path(frames[-1].filename).resolve().parents
        if raised_here and isinstance(error, ValueError | TypeError | AttributeError) and "\n" not in str(error):
            return str(error)
        error = error.__cause__ or error.__context__
    return None


def pytest_sessionfinish(session: Any) -> None:
    """Write what happened for the process that asked for it."""
    told = {"results": RESULTS, "why": WHY}
    Path(os.environ["SB3_SUITE_RESULT"]).write_text(json.dumps(told))

"""Agents of many kinds that the tests of exports act with."""

from __future__ import annotations

import shutil

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from test_events import Bell

from sb3_tbc import TBCHRL
from sb3_tbc.export.check import Player
from sb3_tbc.tbc_hrl import HAC

needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
PENDULUM = {"inter": 6, "command": 6, "motor": 1, "sensory_fanout": 3, "inter_fanout": 4,
            "recurrent_command_synapses": 1, "motor_fanin": 4}  # fmt: skip
DISSIPATIVE = {**PENDULUM, "dynamics": "dissipative", "max_rho": 0.97}
LEAN = {**PENDULUM, "synapses": "lean"}
REFLEX = {**PENDULUM, "sensory_to": ["inter", "command", "motor"]}
CASES = {
    "reached": ("Pendulum", {"window_end": "reached", "memory": "window"}),
    "relative": ("UR5Reacher", {"window_end": "reached", "relative_subgoals": True, "memory": "episode", "dt_min": 3}),
    "whole": ("Pendulum", {"whole_budgets": True, "memory": "window"}),
    "mlp": ("Pendulum", {"window_end": "timed", "memory": "none", "low": {"policy_kwargs": {"ndbc": None}}}),
    "memoryless": ("Pendulum", {"memory": "none"}),
    "hac": ("Pendulum", {}),
    "dissipative": ("Pendulum", {"memory": "window", "low": {"policy_kwargs": {"ndbc": DISSIPATIVE}}}),
    "lean": ("Pendulum", {"window_end": "reached", "memory": "window", "low": {"policy_kwargs": {"ndbc": LEAN}}}),
    "reflex": ("Pendulum", {"memory": "window", "low": {"policy_kwargs": {"ndbc": REFLEX}}}),
    "lean reflex": ("Pendulum", {"memory": "episode", "low": {"policy_kwargs": {"ndbc": {**REFLEX, **LEAN}}}}),
    "event": ("Bell", {"dt_max": 12.0, "memory": "window"}),
}


def make(case: str) -> tuple[TBCHRL, gym.Env]:
    task, kwargs = CASES[case]
    env = Bell() if task == "Bell" else gym.make(f"sb3_tbc/{task}-v0")
    small = {"policy_kwargs": {"net_arch": [12, 8]}}
    algorithm = HAC if case == "hac" else TBCHRL
    model = algorithm("MultiInputPolicy", env, seed=1, compile=False, **{"high": small, **kwargs})
    return model, env


def trained_look(model: TBCHRL, seed: int = 0) -> TBCHRL:
    """Weights as training leaves them: large, some neurons almost without inertia, some logistics almost steps."""
    generator = th.Generator().manual_seed(seed)
    for level in (model.high, model.low):
        with th.no_grad():
            for name, p in level.policy.average_actor.named_parameters():
                p.mul_(4.0 if level is model.high else 3.0).add_(0.3 * th.randn(p.shape, generator=generator))
                if name.endswith("raw_capacitance"):
                    p[::2] = -13.8  # a capacitance of 1e-6
                if name.endswith("raw_gain"):
                    p[::2] = 12.0
        level.acting.refresh()
    return model


def assert_same_actions(one: Player, other: Player, env: gym.Env, steps: int, seed: int = 0) -> None:
    """Both act alike, from the beginning of an episode on, in the states that the first one's actions lead to."""
    seen, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = one.step(seen)
        np.testing.assert_allclose(other.step(seen), action, atol=1e-5)
        seen, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            seen, _ = env.reset()
            one.reset()
            other.reset()

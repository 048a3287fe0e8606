"""The one fast test that really learns: it fails where either level stops learning or hindsight goes wrong."""

from __future__ import annotations

from typing import Any

from corridor import Corridor

from sb3_tbc import TBCHRL
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical


def test_learns_the_corridor_within_two_thousand_steps() -> None:
    """Trained agents reach .8 and more of the goals; untrained ones, and those with a broken part, .4 at most.

    Broken were: a low level that keeps its weights, no update at all, hindsight subgoals from another window.
    """
    level: dict[str, Any] = {"batch_size": 64, "learning_rate": 3e-3, "policy_kwargs": {"net_arch": [32, 32]}}
    model = TBCHRL(
        "MultiInputPolicy",
        Corridor(),
        high={**level, "ent_coef": 0.1},
        low={**level, "actor_learning_rate": 9e-3, "ent_coef": 0.02},
        gradient_ratio=0.5,
        max_options=10,
        duration_cost=0.5,
        relative_subgoals=True,
        compile=False,
        seed=0,
    )
    before = evaluate_hierarchical(model, Corridor(), 60, seed=1).success_rate
    model.learn(2000)
    after = evaluate_hierarchical(model, Corridor(), 60, seed=1).success_rate
    assert before <= 0.5
    assert after >= 0.7, f"before learning {before}, after it {after}"

"""Cut the recorded trajectories of the original tasks down to what the parity tests read.

Usage: ``python compact.py SOURCE`` where ``SOURCE/<Task>/<episode>.npz`` are the full recordings. Writes
``<Task>.npz`` beside this file; keys are ``<episode>/<array>``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

JOINTS = [f"joint_{i}_{what}" for i in range(3) for what in ("angle", "angular_vel")]
TENNIS = [
    "ball_anguler_vel",
    "ball_bounced_at_least_once",
    "ball_bounced_at_least_twice",
    "ball_bouncing_second_time",
    "ball_pos_x",
    "ball_pos_y",
    "ball_vel_x",
    "ball_vel_y",
]
PLAN: dict[str, tuple[list[str], dict[str, int]]] = {  # observation keys in flat order; steps kept per episode
    "Drawbridge": (["bridge_phase", "sails_unfurled", "ship_pos", "ship_vel"], {"ep0": 9999, "ep2": 9999}),
    "Pendulum": ([], {"ep0": 9999, "ep1": 9999, "ep2": 200, "ep3": 9999}),
    "UR5Reacher": ([], {"ep0": 200, "ep1": 9999, "ep2": 200, "ep3": 9999}),
    "AntFourRooms": ([], {"ep0": 40, "ep1": 120, "ep3": 9999}),
    "Platforms": (
        ["ang_vel", "platform0", "platform1", "position", "velocity"],
        {"ep1": 9999, "ep2": 9999, "consecutive_ep0": 9999, "consecutive_ep1": 250},
    ),
    "Tennis2D": (TENNIS + JOINTS, {"ep1": 9999, "consecutive_ep0": 9999, "consecutive_ep1": 250}),
}


def compact_episode(episode: Any, keys: list[str], steps: int) -> dict[str, Any]:
    """Actions, rewards, flags, goal, start and flat observations of the first ``steps`` steps."""
    observation = np.concatenate([episode[f"obs_{key}"] for key in keys], axis=1) if keys else episode["obs"]
    kept = {name: episode[name][:steps] for name in ("action", "reward", "done")}
    kept |= {"observation": observation[: steps + 1], "achieved_goal": episode["achieved_goal"][: steps + 1]}
    kept["goal"] = episode["desired_goal"][0]
    kept |= {name: episode[name] for name in ("init_qpos_sampled", "init_qvel_sampled") if name in episode}
    if "raw_ball" in episode:
        kept["ball_shot"] = episode["raw_ball"][0]
    kept["controller"] = np.array(json.loads(str(episode["meta"])).get("controller", "recorded"))
    return kept


def main(source: Path) -> None:
    """Write one compact file per task."""
    for task, (keys, episodes) in PLAN.items():
        arrays = {
            f"{name}/{key}": array
            for name, steps in episodes.items()
            for key, array in compact_episode(np.load(source / task / f"{name}.npz"), keys, steps).items()
        }
        np.savez_compressed(Path(__file__).with_name(f"{task}.npz"), **arrays)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

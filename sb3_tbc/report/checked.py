"""What a run says of itself is looked at before any of it is averaged, compared or printed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import number, one_line
from sb3_tbc.zoo.callbacks import EvaluationRow
from sb3_tbc.zoo.ledger import EVALUATIONS, curve_summary

SHARES = ("success_rate", "best_success_rate", "stable_share", "worst_after_first_90", "subgoal_success")
NUMBERS = ("mean_length", "mean_length_success", "mean_window", "wall_time", "steps_per_second")
COUNTS = ("n_timesteps", "n_episodes", "seed", "eval_seed")
TEXTS = ("task", "algo", "variant", "env_id", "config", "outcomes")
LARGEST = 1e15
ROUNDED = 1e-6
"""Largest difference that comes from the six digits with which rates are written."""
CURE = "one of them was changed afterwards; train the run again with --overwrite, or move it out of the folder"


def check_final(final: PlainMapping) -> None:
    """Refuse a ``final.json`` whose values are not what they are called.

    :raises ConfigError: naming the value
    """
    number(final.get("success_rate"), "success_rate", 0.0, 1.0)
    for names, high in ((SHARES, 1.0), (NUMBERS, LARGEST), (COUNTS, LARGEST)):
        for name in names:
            if final.get(name) is not None:
                number(final[name], name, 0.0, high)
    for name in COUNTS:
        if not float(final.get(name) or 0).is_integer():
            raise ConfigError(f"{name} must be a whole number, got {final[name]!r}")
    for name in TEXTS:
        if not isinstance(final.get(name), str | None):
            raise ConfigError(f"{name} must be a text, got {one_line(repr(final[name]), 100)}")
    if not re.fullmatch("[01]*", final.get("outcomes") or ""):
        raise ConfigError("outcomes must be a text of 0 and 1")
    _check_outcomes(final)


def _check_outcomes(final: PlainMapping) -> None:
    """Refuse a success rate that is not that of the episodes beside it.

    :raises ConfigError: naming both
    """
    _check_share(final["success_rate"], final.get("n_episodes"), "")
    if outcomes := final.get("outcomes"):
        said = f"outcomes holds {outcomes.count('1')} successes in {len(outcomes)} episodes"
        if final.get("n_episodes") not in (None, len(outcomes)):
            raise ConfigError(f"{said}, but n_episodes is {final['n_episodes']}: {CURE}")
        if abs(outcomes.count("1") / len(outcomes) - final["success_rate"]) > ROUNDED:
            raise ConfigError(f"{said}, but success_rate is {final['success_rate']:g}: {CURE}")


def _check_share(rate: float, episodes: float | None, where: str) -> None:
    """Refuse a success rate that no number of successes in that number of episodes gives.

    :raises ConfigError: naming both
    """
    if episodes and abs(rate * episodes - round(rate * episodes)) > ROUNDED * episodes:
        raise ConfigError(f"{where}success_rate is {rate:g}, which is no share of {episodes:g} episodes: {CURE}")


def check_place(folder: Path, final: PlainMapping) -> None:
    """Refuse a run that lies where another one belongs: a renamed copy would be counted as one more run.

    :param folder: ``<task>/<algo>/<variant>/seed_<n>``
    :param final: its ``final.json``
    :raises ConfigError: naming the first difference, and the cure
    """
    for name, place in zip(("task", "algo", "variant", "seed"), folder.parts[-4:], strict=True):
        said, place = str(final[name]), place.removeprefix("seed_") if name == "seed" else place
        if (re.sub("[/:]", "_", said) if name == "task" else said) != place:
            raise ConfigError(
                f"its final.json is of {name} {one_line(repr(said), 100)}, but its folder of {place!r}; "
                "rename the folder, or move it out of the ledger if it is a copy"
            )


def check_curve(rows: Sequence[EvaluationRow], final: PlainMapping) -> None:
    """Refuse a learning curve that contradicts itself or the result beside it.

    Steps that do not rise would be interpolated wrongly.

    :raises ConfigError: naming the first row or value that is wrong
    """
    for before, (step, rate, episodes, *_) in zip((0, *(row.timesteps for row in rows)), rows, strict=False):
        if step <= before:
            raise ConfigError(f"{EVALUATIONS} must have steps above 0 that rise, got {step} after {before}")
        if episodes < 1:
            raise ConfigError(f"{EVALUATIONS} must have episodes above 0, got {episodes} at step {step}")
        _check_share(rate, episodes, f"{EVALUATIONS}, step {step}: ")
    trained = final.get("n_timesteps")
    if rows and trained is not None and rows[-1].timesteps > trained:
        raise ConfigError(
            f"{EVALUATIONS} ends at step {rows[-1].timesteps}, but final.json is of {trained} steps: {CURE}"
        )
    for name, value in curve_summary(list(rows)).items() if rows else ():
        if name in final and not _equal(final[name], value):
            raise ConfigError(f"{name} is {final[name]}, but {value} by {EVALUATIONS}: {CURE}")


def _equal(one: float | None, other: float | None) -> bool:
    return one is other or (one is not None and other is not None and abs(one - other) <= ROUNDED)


def check_sections(data: PlainMapping, *names: str) -> None:
    """Refuse a value that is not a section of named values where one must be; it may be missing.

    :param names: of the sections; dots lead into one
    :raises ConfigError: naming it
    """
    for name in names:
        part: object = data
        for key in name.split("."):
            part = part.get(key) if isinstance(part, Mapping) else None
        if not isinstance(part, Mapping | None):
            raise ConfigError(f"{name} must hold named values, got {one_line(repr(part), 100)}")

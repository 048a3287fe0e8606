"""Settings of the agents: one field each, with its type, what it may hold, its default, and its help text below it.

Everything else is derived from these classes: the constructor's signature and checks, the keys of configuration files
and ``--hyperparams``, ``train --help-settings``, the settings page of the documentation, and what a saved agent
remembers. A new setting is one field here and the code that uses it. Settings of a level are in
:mod:`sb3_tbc.tbc_hrl.level_config`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, Self

from sb3_tbc.settings import Range, SettingError, Settings
from sb3_tbc.tbc_hrl.level_config import (
    Fraction,
    HighConfig,
    LearningRate,
    LevelConfig,
    LowConfig,
    LowPolicyConfig,
    NetArch,
    NotNegative,
    Positive,
    Price,
    Temperature,
    UpdateRatio,
    Width,
)

WINDOW_STEPS = 10
"""Steps of an episode for each decision with ``max_options: auto``: time for the low level to do something."""
MOST_OPTIONS = 10
"""Most decisions with ``max_options: auto``, however long an episode is."""


@dataclass(frozen=True, kw_only=True)
class AgentConfig(Settings):
    """Settings of an agent of two levels that are not of one level alone."""

    max_options: Annotated[int, Range(1, 1_000_000)] | Literal["auto"] = 20
    """High-level decisions allowed per episode; ``auto``: one for every ten steps of an episode, at most 10; windows
    with ``window_end: timed`` and the longest time budget derived then last half of it at least."""
    window_end: Literal["timed", "reached", "reconsider"] = "timed"
    """What ends a window. ``timed``: its time budget alone (HiTS). ``reached``: reaching the subgoal as well (algorithm
    1). ``reconsider``: also the high level, when its critic values a new option more than the rest of this one (arXiv
    2211.06351)."""
    reconsider_margin: Price = 1.0
    """How much more a new option must be worth to end a window with ``window_end: reconsider``, in the high level's
    rewards; 1 is the price of a decision."""
    dt_min: NotNegative = 0.0
    """Shortest time budget, environment steps."""
    dt_max: Annotated[float, Range(1, also=(-1,))] = -1.0
    """Longest time budget, environment steps; -1: the episode's length divided by ``max_options``."""
    whole_budgets: bool = False
    """Round time budgets to the nearest whole number of steps, as the paper does (section 4.1); else a fractional
    budget lasts until the first step that is not shorter."""
    duration: Literal["joint", "rule", "fixed"] = "joint"
    """Who sets the time budget. ``joint``: the high level, together with the subgoal. ``rule``: the rule of equation 1,
    ``clip(kappa * H_reach, dt_min, dt_max)``. ``fixed``: nobody, it is always ``fixed_duration``."""
    fixed_duration: Positive | None = None
    """Constant time budget for ``duration: fixed``, environment steps; null: ``dt_max``."""
    kappa: Positive = 1.0
    """Factor by which the rule multiplies the estimated steps to a subgoal (equation 1, table A2)."""
    duration_loss_coef: Price = 0.0
    """Weight of the loss that draws the high level's time budget toward the rule's (section 4.2), in unit action
    coordinates; 0 leaves it out."""
    remaining_time: bool = True
    """Whether the low level sees how much of its time budget is left."""
    target: Literal["smdp", "decision"] = "smdp"
    """What the high level learns from a window. ``smdp``: all its rewards, and a discount per step (paper).
    ``decision``: its last reward, and a discount per decision (HiTS)."""
    decision_cost: Price = 1.0
    """Price of each decision of the high level; with ``target: smdp`` only, HiTS's reward has it built in."""
    duration_cost: Price = 2.0
    """Price of the longest time budget; shorter ones cost in proportion."""
    completion_bonus: Price = 0.0
    """Added to the high level's reward where an option reaches its subgoal, in hindsight too (section 4.5)."""
    low_reward: Literal["sparse", "dense", "step"] = "sparse"
    """The low level's reward. ``sparse``: 1 where the window ends with its subgoal reached. ``dense``: the same, plus
    how much nearer each step came to the subgoal. ``step``: -1 for each step until the subgoal is reached (HAC)."""
    testing_fraction: Fraction = 0.3
    """Share of options that test their subgoal: a failed test is punished."""
    deterministic_testing: bool = False
    """Whether the low level acts without noise in a test; the public HiTS does not."""
    testing_penalty: Annotated[float, Range(-1e6, 0)] | None = None
    """Reward of a failed test; null: minus ``max_options``."""
    keep_original: bool = False
    """Also learn from failed options as they were chosen, besides what hindsight makes of them (algorithm 1)."""
    relabel_tolerance: NotNegative | None = None
    """Largest distance, in unit coordinates, between where a failed option ended and the subgoal it is relabelled with
    (the paper's success test: 0.05); null: all failed options are relabelled."""
    random_fraction: Fraction = 0.05
    """Share of uniformly random actions on each level while exploring."""
    n_hindsight_goals: Annotated[int, Range(0, 1_000_000)] = 3
    """Number of hindsight goals for each transition."""
    n_hindsight_cuts: Annotated[int, Range(0, 1000)] = 0
    """How often a finished episode is cut anew into windows of random length. Whatever the low level did in such a
    window is one more option, in hindsight, for the high level to learn from."""
    hindsight_cuts_fraction: Fraction = 1.0
    """Share of the training, from its beginning, in which episodes are cut anew; later the high level learns only from
    what it chose."""
    goal_strategy: Literal["future", "episode", "event"] = "future"
    """Where the high level's hindsight goals come from. ``future``: later options of the episode. ``episode``: any of
    its options. ``event``: the option that the task's event ended."""
    goals_met: Literal["passing", "end"] = "passing"
    """What counts as meeting a hindsight goal. ``passing``: the window passes it, since the episode would have ended
    there. ``end``: the window ends at it; with ``target: decision`` this is always used."""
    gradient_ratio: UpdateRatio = 1.0
    """Updates of each level per environment step, done in bursts after episodes."""
    learning_starts: Annotated[int, Range(0)] = 0
    """Environment steps before the first update."""
    memory: Literal["window", "episode", "none"] = "none"
    """When the circuit's memory is reset. ``window``: when a window ends. ``episode``: when the episode ends. ``none``:
    at every step, so that nothing is remembered."""
    sequence_length: Annotated[int, Range(1, 64)] = 1
    """Number of steps through which an update of the low level unrolls its memory and learns by backpropagation through
    time; 1: the stored memory is used as it is."""
    relative_subgoals: bool = False
    """Show the low level the distance to its subgoal instead of the subgoal itself."""
    compile: bool | Literal["auto"] = "auto"
    """Compile the updates; ``auto``: if a C++ compiler is found and the run is long enough to gain from it."""
    on_bad_step: Literal["stop", "end-episode"] = "stop"
    """What happens when an environment gives a value that is not finite or has the wrong shape. ``stop``: the run
    stops, saved. ``end-episode``: the episode ends with the step before, and the next one begins."""

    def for_episodes_of(self, steps: int | None) -> Self:
        """These settings with ``max_options`` as a number, and windows that do not use them up in half an episode.

        :param steps: time limit of the task; None where it has none
        :raises SettingError: if ``max_options`` is to be derived from a time limit that there is not
        """
        if self.max_options != "auto":
            return self
        if steps is None:
            raise SettingError(
                "max_options", "of 'auto' needs an environment with a time limit; say how many decisions"
            )
        options = min(max(steps // WINDOW_STEPS, 1), MOST_OPTIONS)
        shortest = steps / options / 2 if self.window_end == "timed" and self.dt_max == -1 else 0.0
        return replace(self, max_options=options, dt_min=max(self.dt_min, shortest))

    def check(self) -> None:
        """Refuse what cannot be meant together."""
        if self.dt_max != -1 and self.dt_min >= self.dt_max:
            raise SettingError("dt_min", f"must be below dt_max={self.dt_max:g}, got {self.dt_min:g}")
        if self.sequence_length > 1 and self.memory == "none":
            raise SettingError(
                "sequence_length",
                f"of {self.sequence_length} unrolls the low level's memory, but memory='none' keeps none: use "
                "memory='window' or sequence_length=1",
            )
        if self.duration_loss_coef and self.duration != "joint":
            raise SettingError(
                "duration_loss_coef",
                f"of {self.duration_loss_coef} teaches a high level that chooses its time budgets: use "
                f"duration='joint' (here {self.duration!r}), or 0",
            )
        if self.window_end == "reconsider" and self.duration != "joint":
            raise SettingError(
                "window_end",
                "of 'reconsider' asks the high level's critic what the rest of a time budget is worth, which it knows "
                f"only where the high level chooses time budgets: use duration='joint' (here {self.duration!r})",
            )
        if self.fixed_duration is not None and self.duration != "fixed":
            raise SettingError(
                "fixed_duration", f"of {self.fixed_duration:g} needs duration='fixed', got duration={self.duration!r}"
            )


@dataclass(frozen=True, kw_only=True)
class TBCConfig(AgentConfig):
    """All settings of TBC-HRL."""

    high: HighConfig = field(default_factory=HighConfig)
    """The high level, which chooses subgoals and time budgets."""
    low: LowConfig = field(default_factory=LowConfig)
    """The low level, which executes subgoals."""

    def check(self) -> None:
        """Refuse what cannot be meant together."""
        super().check()
        if self.low.policy_kwargs.critic_memory and self.memory == "none":
            raise SettingError(
                "low.policy_kwargs.critic_memory",
                "shows the critics the low level's memory, but memory='none' keeps none: use memory='window' or "
                "memory='episode'",
            )
        if self.low.goal_strategy is not None and self.low_reward != "step":
            raise SettingError(
                "low.goal_strategy",
                f"{self.low.goal_strategy!r} has an effect with low_reward='step' alone, here it is "
                f"{self.low_reward!r}: hindsight subgoals that depend on time come from the same window",
            )
        if self.low.policy_kwargs.negative_critic and self.low_reward != "step":
            raise SettingError(
                "low.policy_kwargs.negative_critic",
                f"keeps the critic's values below zero, but a subgoal reached is worth 1 with low_reward="
                f"{self.low_reward!r}, so nothing would be learnt: leave it out, or use low_reward='step'",
            )
        if self.high.policy_kwargs.negative_critic and self.bonus_beyond_cost:
            price = f"decision_cost={self.decision_cost:g}" if self.target == "smdp" else "target='decision'"
            raise SettingError(
                "completion_bonus",
                f"of {self.completion_bonus:g} with {price} makes rewards above zero, which a high level's critic with "
                "policy_kwargs.negative_critic=True cannot learn: leave negative_critic out, or use a smaller bonus",
            )

    def updates_per_step(self, level: LevelConfig) -> float:
        """Updates of one of the levels per environment step."""
        return float(self.gradient_ratio if level.gradient_ratio is None else level.gradient_ratio)

    @property
    def bonus_beyond_cost(self) -> bool:
        """Whether the completion bonus can make a decision's reward positive, for a task whose rewards never are.

        With ``target: smdp`` a decision has its price; with ``target: decision`` the reward of a success is 0 already.
        """
        return self.completion_bonus > (self.decision_cost if self.target == "smdp" else 0.0)

    @property
    def failed_test_reward(self) -> float:
        """What a failed test of a subgoal is rewarded with."""
        return -float(self.max_options) if self.testing_penalty is None else self.testing_penalty


NO_CIRCUIT = LowConfig(policy_kwargs=LowPolicyConfig(ndbc=None))
"""A low level whose actor is an MLP."""


@dataclass(frozen=True, kw_only=True)
class HiTSConfig(TBCConfig):
    """HiTS: windows run their full time, the reward is per decision, the low level is an MLP."""

    target: Literal["smdp", "decision"] = "decision"
    low: LowConfig = NO_CIRCUIT


@dataclass(frozen=True, kw_only=True)
class HACConfig(TBCConfig):
    """HAC: windows end at their subgoal, time is neither chosen nor seen, the low level is an MLP."""

    window_end: Literal["timed", "reached", "reconsider"] = "reached"
    duration: Literal["joint", "rule", "fixed"] = "fixed"
    remaining_time: bool = False
    target: Literal["smdp", "decision"] = "decision"
    low_reward: Literal["sparse", "dense", "step"] = "step"
    low: LowConfig = NO_CIRCUIT


@dataclass(frozen=True, kw_only=True)
class FlatPolicyConfig(Settings):
    """Networks of the flat baseline; names as in Stable-Baselines3's ``policy_kwargs``."""

    net_arch: tuple[Width, ...] | NetArch = (256, 256)
    """Neurons of each hidden layer, for actor and critics alike, or ``pi`` and ``qf`` where they differ."""
    n_critics: Annotated[int, Range(1, 100)] = 2
    """Number of critics; the lowest of their values counts."""


@dataclass(frozen=True, kw_only=True)
class FlatConfig(Settings):
    """All settings of flat SAC; names and defaults as in Stable-Baselines3."""

    learning_rate: LearningRate = 3e-4
    """Learning rate of critics, actor and temperature; ``lin_<rate>`` falls linearly to zero at the end of training."""
    batch_size: Annotated[int, Range(1, 1_000_000)] = 256
    """Number of transitions in each update."""
    gamma: Fraction = 0.99
    """Discount per environment step."""
    tau: Annotated[float, Range(0, 1, above=True)] = 0.005
    """Polyak factor of the target critics."""
    ent_coef: Temperature = "auto"
    """Temperature: a fixed one, ``auto``, or ``auto_<number>`` that starts there."""
    target_entropy: float | Literal["auto"] = "auto"
    """Entropy that an automatic temperature aims at; auto: minus the number of action dimensions."""
    average_decay: Annotated[float, Range(0, 1, below=True)] = 0.0
    """Decay per update of an averaged actor, which acts where deterministic actions are asked for; 0: no average, as in
    Stable-Baselines3."""
    buffer_size: Annotated[int, Range(1, 1_000_000_000)] = 1_000_000
    """Largest number of transitions in the replay buffer."""
    learning_starts: Annotated[int, Range(0)] = 100
    """Environment steps before the first update, in which actions are uniformly random."""
    gradient_ratio: UpdateRatio = 1.0
    """Updates per environment step, done every 100 steps."""
    n_hindsight_goals: Annotated[int, Range(0, 1_000_000)] = 3
    """Number of relabelled samples for each plain one."""
    goal_strategy: Literal["future", "episode", "event"] = "future"
    """Where hindsight goals come from. ``future``: later steps of the episode. ``episode``: any of its steps.
    ``event``: the step of the task's event."""
    on_bad_step: Literal["stop", "end-episode"] = "stop"
    """What happens when an environment gives a value that is not finite or has the wrong shape. ``stop``: the run
    stops, saved. ``end-episode``: the episode ends with the step before, and the next one begins."""
    policy_kwargs: FlatPolicyConfig = FlatPolicyConfig()
    """Networks."""

"""Hindsight as pure functions on arrays: what both levels learn from a finished episode. NumPy only.

Two relabellings (paper sections 4.2 and 4.5; HAC and HiTS before it): *hindsight action relabelling* (the paper's HGR)
replaces an option that was not achieved by the one that was, and *hindsight goal relabelling* replaces the goal by one
that was reached later. *Testing transitions* punish options that the low level could not achieve.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_tbc.arrays import BoolArray, FloatArray, IntArray
from sb3_tbc.smdp.cuts import cut_anew
from sb3_tbc.smdp.options import Episode, OptionRules, TerminationReason
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.smdp.views import LevelViews


def check_goal_strategy(strategy: str, subgoals: SubgoalSpace | None) -> None:
    """Check that hindsight goals can be chosen this way.

    :param strategy: ``"future"``, ``"episode"`` or ``"event"``, see :func:`goal_pairs`
    :param subgoals: the task's
    :raises ValueError: if they are to come from an event and the task names none
    """
    if strategy == "event" and (subgoals is None or subgoals.event is None):
        raise ValueError(
            "goal_strategy 'event' takes goals from the step of a task's event, and this task names none: use 'future' "
            "or 'episode', or give its SubgoalSpace the index of the event's flag in the observation"
        )


class GoalTest(NamedTuple):
    """A task's reward and termination as batched functions of ``(achieved_goal, desired_goal)``."""

    reward: Callable[[FloatArray, FloatArray], FloatArray]  # (n, goal_dim) x 2 -> (n,)
    terminated: Callable[[FloatArray, FloatArray], BoolArray]  # (n, goal_dim) x 2 -> (n,)


class LowLevelSteps(NamedTuple):
    """The low level's transitions of one episode, one row per environment step."""

    local: FloatArray  # (T, local_dim) what the low level sees of the task
    next_local: FloatArray
    actions: FloatArray  # (T, action_dim) unit coordinates
    states: FloatArray  # (T, state_dim) membrane potentials before the step
    next_states: FloatArray
    subgoal: FloatArray  # (T, subgoal_dim) what was asked for, task units
    here: FloatArray  # (T, subgoal_dim) subgoal-space point before the step
    achieved: FloatArray  # and after it
    time_left: FloatArray  # (T,) steps of the budget left before the step
    position: IntArray  # (T,) steps since the window began
    length: IntArray  # (T,) steps the window took
    rewards: FloatArray  # (T,)
    dones: BoolArray  # (T,) the window is over: no bootstrap


def low_level_steps(episode: Episode, reward: LowLevelReward) -> LowLevelSteps:
    """Ordinary transitions of the low level.

    A window that the end of the episode cuts off is not over for the low level: its last step bootstraps.

    :param episode: a finished one, of T steps
    :param reward: the low level's
    """
    lengths = np.array([option.duration for option in episode.options])
    position = np.concatenate([np.arange(n) for n in lengths])
    per_step = np.repeat(np.arange(len(lengths)), lengths)
    budget = np.array([option.time_budget for option in episode.options])[per_step]
    subgoal = np.stack([option.subgoal for option in episode.options])[per_step]
    seen = episode.seen(slice(None))
    local, points = reward.subgoals.local(seen), reward.subgoals.achieved(seen)
    rewards, over = reward.rewards_and_ends(
        points[:-1], points[1:], subgoal, position + 1 >= budget, may_end=position + 1 >= reward.rules.dt_min
    )
    return LowLevelSteps(
        local=local[:-1],
        next_local=local[1:],
        actions=episode.actions,
        states=episode.states,
        next_states=episode.next_states,
        subgoal=subgoal,
        here=points[:-1],
        achieved=points[1:],
        time_left=budget - position,
        position=position,
        length=lengths[per_step],
        rewards=rewards,
        dones=over,
    )


def ordered_pairs(length: IntArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """A uniformly drawn pair ``0 <= first <= second < length`` for each window length, ``(n,)`` each."""
    first = rng.integers(0, length)
    second = rng.integers(0, length + 1)
    # the half of the (length x length + 1) rectangle above the diagonal folds onto the half below it
    fold = second > first
    return np.where(fold, length - second, second), np.where(fold, length - 1 - first, first)


class HighLevelSteps(NamedTuple):
    """The high level's SMDP transitions of one episode, hindsight copies included, one row each."""

    observations: FloatArray  # (n, observation_dim) flat, when the option began
    actions: FloatArray  # (n, subgoal_dim + 1) subgoal and time budget, unit coordinates
    rewards: FloatArray  # (n,)
    next_observations: FloatArray
    dones: BoolArray  # (n,) no bootstrap
    discounts: FloatArray  # (n,) of the value after the option
    relabelled: BoolArray  # (n,) whether the action is a hindsight one
    durations: IntArray  # (n,) environment steps
    local: FloatArray  # (n, local_dim) what the low level saw when the option began
    here: FloatArray  # (n, subgoal_dim) and the subgoal-space point where it began

    def first(self, rows: int) -> HighLevelSteps:
        """So many of them, or all if there are fewer."""
        return self._replace(**{name: column[:rows] for name, column in self._asdict().items()})


class HindsightSettings(NamedTuple):
    """How much hindsight the high level uses."""

    n_goals: int  # goal copies per option
    goal_strategy: str  # "future", "episode" or "event"
    testing_penalty: float  # reward of a testing transition, negative
    keep_original: bool  # also store failed options as they were chosen (paper, algorithm 1 line 26)
    tolerance: float | None = None  # relabelled options further than this from where they ended are not a success
    goals_met: str = "passing"  # what counts as meeting a hindsight goal: "passing" it, or being there at the "end"
    n_cuts: int = 0  # how often the episode is cut anew into windows, see :func:`.cut_anew`
    cut_lengths: tuple[int, int] = (1, 1)  # fewest and most steps of these windows
    cuts_fraction: float = 1.0  # share of the training, from its beginning, with such cuts

    def after(self, progress: float) -> HindsightSettings:
        """These settings when this share of the training is done."""
        return self if progress <= self.cuts_fraction else self._replace(n_cuts=0)


def relabel_actions(
    episode: Episode,
    subgoals: SubgoalSpace,
    rules: OptionRules,
    rng: np.random.Generator,
    tolerance: float | None = None,
) -> tuple[FloatArray, BoolArray]:
    """The action each option turned out to be, ``(n_options, subgoal_dim + 1)``, and which of them changed.

    An achieved option keeps its action; another becomes (point reached, time it took), with the time drawn so that
    the budget would have expired at just that step.

    :param episode: a finished one
    :param subgoals: the task's
    :param rules: what ended its options, and the range of time budgets
    :param rng: draws the time budgets
    :param tolerance: the success test of hindsight (paper section 4.5). A point outside of the subgoals' bounds is
        replaced by the nearest subgoal. If it lies further from that than ``tolerance`` (unit coordinates), the
        hindsight option would have failed as well, so the option keeps its action. None: every point is replaced
    """
    actions = np.stack([option.unit_action for option in episode.options])
    failed = np.array([not option.reached for option in episode.options])
    if failed.any():
        ends = np.array([option.start + option.duration for option in episode.options])[failed]
        durations = np.array([option.duration for option in episode.options])[failed]
        reached = subgoals.achieved(episode.seen(ends))
        took = rules.budget_that_lasted(durations, rng)
        unit = subgoals.scale(reached)
        if tolerance is not None:
            success = hindsight_success(unit, np.clip(unit, -1.0, 1.0), tolerance)
            failed[failed] = success
            unit, took = unit[success], took[success]
        actions[failed, :-1] = np.clip(unit, -1.0, 1.0)
        actions[failed, -1] = rules.unit_budget(np.maximum(took, rules.dt_min))
    return actions, failed


def hindsight_success(reached: FloatArray, subgoal: FloatArray, tolerance: float = 0.05) -> BoolArray:
    """Whether relabelled options succeed: ``||phi(s') - phi(g_hat)||_2 <= tolerance`` (paper section 4.5), ``(n,)``.

    :param reached: where the options ended, unit coordinates ``(n, subgoal_dim)``
    :param subgoal: their hindsight subgoals, unit coordinates
    :param tolerance: largest distance of a success, unit coordinates
    """
    return np.asarray(np.linalg.norm(reached - subgoal, axis=-1) <= tolerance)


def failed_tests(episode: Episode) -> BoolArray:
    """Which options tested their subgoal and missed it, ``(n_options,)``; not one that the task's success cut off."""
    last = len(episode.options) - 1
    return np.array(
        [
            option.testing
            and not option.reached
            and not (i == last and episode.success and option.reason is TerminationReason.EPISODE_END)
            for i, option in enumerate(episode.options)
        ]
    )


def goal_pairs(
    n_options: int, n_goals: int, strategy: str, rng: np.random.Generator, event: int | None = None
) -> IntArray:
    """Rows ``(option, option whose outcome becomes its goal)`` for hindsight goal relabelling, ``(n, 2)``.

    ``"future"`` draws from the later options of the episode, never an option's own outcome (as HiTS and HAC);
    ``"episode"`` from all of them; ``"event"`` gives every option one goal, the outcome of the option that the task's
    event ended, and none in an episode without it (as HiTS in Tennis2D, whose goals hold at the second bounce alone).

    :param n_options: options of the episode
    :param n_goals: goals for each option, as far as there are as many to choose from
    :param strategy: one of the above
    :param rng: draws the goals
    :param event: the option that the event ended, None if there was none
    """
    options = np.arange(n_options)
    if strategy == "event":
        return np.stack([options, np.full(n_options, event)], axis=1) if event is not None else np.zeros((0, 2), int)
    if strategy == "episode":
        pairs = np.repeat(options, min(n_goals, n_options))
        return np.stack([pairs, rng.integers(0, n_options, len(pairs))], axis=1)
    later = n_options - 1 - options
    pairs = np.repeat(options, np.minimum(n_goals, later))
    return np.stack([pairs, rng.integers(pairs + 1, n_options)], axis=1)


def high_level_steps(
    episode: Episode,
    views: LevelViews,
    rules: OptionRules,
    reward: HighLevelReward,
    settings: HindsightSettings,
    goal_test: GoalTest,
    rng: np.random.Generator,
) -> HighLevelSteps:
    """All SMDP transitions that the high level learns from in one episode, in this order:

    testing transitions (failed tests, chosen action, penalty), hindsight-action transitions of all options, and
    copies of these with hindsight goals; then those of the same episode cut anew, as often as asked for.

    A test that the task's success cut off has not failed: its subgoal was not needed any more.

    :param episode: a finished one
    :param views: what the high level sees and chooses
    :param rules: what ended its options
    :param reward: the high level's
    :param settings: how much hindsight there is
    :param goal_test: the task's rewards and ends under other goals
    :param rng: draws goals and time budgets
    """
    source = _TransitionSource(episode, views, rules, reward, settings, rng)
    parts = [source.failed_tests(settings.testing_penalty)]
    if settings.keep_original:
        parts.append(source.as_chosen())
    parts += source.in_hindsight(goal_test, rng)
    for _ in range(settings.n_cuts):
        cut = cut_anew(episode, views.subgoals, settings.cut_lengths, rng)
        parts += _TransitionSource(cut, views, rules, reward, settings, rng, chosen=False).in_hindsight(goal_test, rng)
    return HighLevelSteps(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class _Options:
    """The options of an episode as arrays, one row each.

    :param actions: their hindsight actions, ``(n, subgoal_dim + 1)``
    :param changed: which of these differ from the chosen actions, ``(n,)``
    """

    def __init__(self, episode: Episode, subgoals: SubgoalSpace, actions: FloatArray, changed: BoolArray) -> None:
        options = episode.options
        self.starts = np.array([option.start for option in options])
        self.durations = np.array([option.duration for option in options])
        self.ends = self.starts + self.durations
        self.chosen = np.stack([option.unit_action for option in options])
        self.reached = np.array([option.reached for option in options])
        self.failed_test = failed_tests(episode)
        self.actions, self.changed = actions, changed
        self.before, self.after = episode.seen(self.starts), episode.seen(self.ends)
        self.local, self.here = subgoals.local(self.before), subgoals.achieved(self.before)
        self.dones = np.zeros(len(options), dtype=bool)
        self.dones[-1] = episode.terminated
        happened = np.flatnonzero(subgoals.happened(self.after))
        self.event = int(happened[0]) if len(happened) else None  # the option that the task's event ended


class _TransitionSource:
    """Makes the high level's transitions of an episode from its options.

    :param chosen: whether the high level chose these options; if not, there is nothing to be learned of those that
        hindsight leaves out
    """

    def __init__(
        self,
        episode: Episode,
        views: LevelViews,
        rules: OptionRules,
        reward: HighLevelReward,
        settings: HindsightSettings,
        rng: np.random.Generator,
        chosen: bool = True,
    ) -> None:
        actions, changed = relabel_actions(episode, views.subgoals, rules, rng, settings.tolerance)
        self.options = options = _Options(episode, views.subgoals, actions, changed)
        self.views, self.rules, self.reward, self.settings, self.episode = views, rules, reward, settings, episode
        self.rewards = reward.window_rewards(episode.rewards, options.starts, options.durations)
        self.bonus = reward.completion_bonus * (options.reached | options.changed)
        self.left_out = np.zeros(len(changed), dtype=bool) if chosen else ~changed

    def failed_tests(self, penalty: float) -> HighLevelSteps:
        """Failed tests of subgoals, under the actions that were chosen, with the penalty as reward."""
        o = self.options
        rows = np.flatnonzero(o.failed_test)
        return self._steps(rows, o.chosen[rows], np.full(len(rows), penalty), o.dones[rows], o.durations[rows], False)

    def as_chosen(self) -> HighLevelSteps:
        """Options that hindsight changes, as they were chosen; failed tests have their penalty instead."""
        o = self.options
        rows = np.flatnonzero(o.changed & ~o.failed_test)
        charged = self._charged(self.rewards[rows], o.chosen[rows])
        return self._steps(rows, o.chosen[rows], charged, o.dones[rows], o.durations[rows], False)

    def in_hindsight(self, goal_test: GoalTest, rng: np.random.Generator) -> list[HighLevelSteps]:
        """All options under their hindsight actions, and copies of them with hindsight goals."""
        o, settings = self.options, self.settings
        parts = [self.as_relabelled()]
        pairs = goal_pairs(len(o.starts), settings.n_goals, settings.goal_strategy, rng, o.event)
        pairs = pairs[~self.left_out[pairs[:, 0]]]
        if len(pairs):
            at_end = self.reward.target == "decision" or settings.goals_met == "end"
            parts.append(self.with_hindsight_goals(pairs, goal_test, at_end))
        return parts

    def as_relabelled(self) -> HighLevelSteps:
        """All options under their hindsight actions; a failed test that has none only has its penalty."""
        o = self.options
        rows = np.flatnonzero((o.reached | o.changed | ~o.failed_test) & ~self.left_out)
        gained = self._charged(self.rewards, o.actions) + self.bonus
        return self._steps(rows, o.actions[rows], gained[rows], o.dones[rows], o.durations[rows], True)

    def with_hindsight_goals(self, pairs: IntArray, goal_test: GoalTest, at_end: bool) -> HighLevelSteps:
        """Options under their hindsight actions and hindsight goals.

        :param pairs: from :func:`goal_pairs`
        :param at_end: see :func:`relabel_goals`
        """
        o, rows = self.options, pairs[:, 0]
        goals = self.episode.achieved_goal[o.ends[pairs[:, 1]]]
        copies = relabel_goals(self.episode, o.starts[rows], o.durations[rows], goals, self.reward, goal_test, at_end)
        gained = self._charged(copies.rewards, o.actions[rows]) + self.bonus[rows]
        dones = copies.dones if self.episode.success else copies.dones | o.dones[rows]  # a failure ends with any goal
        return self._steps(rows, o.actions[rows], gained, dones, copies.durations, True, goals)

    def _charged(self, rewards: FloatArray, actions: FloatArray) -> FloatArray:
        """Rewards less the price of the time budgets in ``actions``."""
        return rewards - self.reward.price(self.rules.budget(actions[:, -1]))

    def _steps(
        self,
        rows: IntArray,
        actions: FloatArray,
        rewards: FloatArray,
        dones: BoolArray,
        durations: IntArray,
        relabelled: bool,
        goals: FloatArray | None = None,
    ) -> HighLevelSteps:
        o = self.options
        old, new = ({key: values[rows] for key, values in part.items()} for part in (o.before, o.after))
        if goals is not None:
            old["desired_goal"] = new["desired_goal"] = goals
        return HighLevelSteps(
            self.views.high(old), actions, rewards, self.views.high(new), dones, self.reward.discounts(durations),
            o.changed[rows] & relabelled, durations, o.local[rows], o.here[rows],
        )  # fmt: skip


class RelabelledGoals(NamedTuple):
    """Reward, end and length of windows under other goals."""

    rewards: FloatArray
    dones: BoolArray
    durations: IntArray


def relabel_goals(
    episode: Episode,
    starts: IntArray,
    durations: IntArray,
    goals: FloatArray,
    reward: HighLevelReward,
    goal_test: GoalTest,
    at_end: bool,
) -> RelabelledGoals:
    """Rewards of n windows had their goals been others.

    :param episode: the one they belong to
    :param starts: first step of each window, ``(n,)``
    :param durations: steps of each window, ``(n,)``
    :param goals: ``(n, goal_dim)``, task units
    :param reward: the high level's
    :param goal_test: the task's rewards and ends under other goals
    :param at_end: look at the last step only, as HiTS does; else a window ends at the first step that meets the new
        goal, as the episode would have. Where motion is erratic a goal is passed by chance, and the hindsight action,
        the point where the window ended, would seldom pass it again
    """
    offsets = np.concatenate([[0], np.cumsum(durations)[:-1]])
    step = np.arange(int(durations.sum())) - np.repeat(offsets, durations) + np.repeat(starts, durations)
    achieved, wanted = episode.achieved_goal[step + 1], np.repeat(goals, durations, axis=0)
    step_rewards, met = goal_test.reward(achieved, wanted), goal_test.terminated(achieved, wanted)
    last = offsets + durations - 1
    if at_end:
        return RelabelledGoals(reward.window_rewards(step_rewards, offsets, durations), met[last], durations)
    met_before: IntArray = np.cumsum(met) - met
    over = met_before - np.repeat(met_before[offsets], durations) > 0
    rewards = reward.window_rewards(np.where(over, 0.0, step_rewards), offsets, durations)
    dones = np.logical_or.reduceat(met, offsets)
    return RelabelledGoals(rewards, dones, np.add.reduceat(~over, offsets).astype(np.int64))

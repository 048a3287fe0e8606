'use strict';
// Both levels as one policy: when options begin and end, what each level sees. Single precision where Python has it.

const single = (values) => Array.from(values, Math.fround);

/** The nearest whole number, of two the even one, as NumPy rounds; Math.round takes the larger one. */
function toWhole(x) {
  const rounded = Math.round(x);
  return rounded - x === 0.5 && rounded % 2 !== 0 ? rounded - 1 : rounded;
}

class TwoLevels {
  constructor(policy) {
    this.p = policy;
    this.low = makeLow(policy.low);
    this.begin();
  }

  /** Begin an episode. */
  begin() {
    const units = this.low.remembers ? this.low.size : 0;
    Object.assign(this, { elapsed: 0, budget: 0, used: 0, first: true, memory: new Float64Array(units) });
    this.subgoal = this.p.subgoal_low.map(() => 0);
  }

  /** One step's decision for a goal observation {observation, achieved_goal, desired_goal}. */
  act(seen, lesion) {
    const o = {};
    for (const key of ['observation', 'achieved_goal', 'desired_goal']) o[key] = single(seen[key]);
    const entries = o.observation.concat(o.achieved_goal), began = this.over(entries, o);
    if (this.p.memory === 'none' || (began && this.p.memory === 'window') || this.first) this.memory.fill(0);
    if (began) this.choose(o);
    this.first = false;
    const left = this.budget - this.elapsed, inputs = this.lowInputs(entries, left);
    const { means, units } = this.low.step(inputs, this.memory, lesion);
    if (this.low.remembers) this.memory = Float64Array.from(units, Math.fround);
    this.elapsed += 1;
    return { action: this.squash(means), units, inputs, began, left, subgoal: this.subgoal.slice(), used: this.used };
  }

  over(entries, o) {
    if (this.first || this.elapsed >= this.budget) return true;
    if (this.p.event !== null && o.observation[this.p.event] > 0.5 && this.elapsed > 0) return true;
    return this.p.window_end === 'reached' && this.elapsed >= this.p.dt_min && this.reached(this.achieved(entries));
  }

  choose(o) {
    const seen = o.desired_goal.concat(o.observation, this.p.achieved_in_observation ? [] : o.achieved_goal);
    let x = single(seen);
    const { weights, biases, activation } = this.p.high, last = weights.length - 1;
    weights.forEach((w, k) => {
      x = dense(x, w, biases[k]);
      if (k < last) x = x.map((a) => (activation === 'relu' ? Math.max(a, 0) : Math.tanh(a)));
    });
    const bound = this.p.mean_bounds[0] ?? Infinity, n = this.p.subgoal_low.length;
    const unit = x.map((a) => Math.fround(Math.tanh(Math.min(Math.max(Math.fround(a), -bound), bound))));
    const span = (low, high, u) => low + 0.5 * (u + 1) * (high - low);
    this.subgoal = this.p.subgoal_low.map((low, i) => span(low, this.p.subgoal_high[i], unit[i]));
    const steps = span(this.p.dt_min, this.p.dt_max, unit[n]);
    this.budget = this.p.fixed_budget ?? (this.p.whole_budgets ? Math.max(toWhole(steps), 1) : steps);
    this.elapsed = 0;
    this.used += 1;
  }

  lowInputs(entries, left) {
    const here = this.p.relative_subgoals ? this.achieved(entries) : null;
    const asked = this.subgoal.map((s, i) => (here ? s - here[i] : s));
    const time = this.p.remaining_time ? [Math.min(Math.max(left / this.p.dt_max, 0), 1)] : [];
    return single(this.p.local.map((i) => entries[i]).concat(asked, time));
  }

  /** The subgoal-space point of a state. */
  achieved(entries) {
    return this.p.achieved.map((c) => {
      const value = entries[c.first];
      if (c.kind === 'angle') return Math.atan2(value, entries[c.second]);
      if (c.kind === 'wrap') return value % c.high;
      return Math.min(Math.max(value, c.low ?? -Infinity), c.high ?? Infinity);
    });
  }

  reached(here) {
    return this.p.groups.every((group, k) =>
      Math.hypot(...group.map((i) => here[i] - this.subgoal[i])) < this.p.thresholds[k]);
  }

  squash(means) {
    const bound = this.p.mean_bounds[1] ?? Infinity;
    return means.map((mean, a) => {
      const unit = Math.fround(Math.tanh(Math.min(Math.max(Math.fround(mean), -bound), bound)));
      const low = this.p.action_low[a], high = this.p.action_high[a];
      return Math.fround(low + 0.5 * (unit + 1) * (high - low));
    });
  }
}

/** A whole episode of a simulated task, from its start to success or to its end. */
function simulate(levels, task, start, goal, lesion, maxOptions) {
  const state = task.begin(start), steps = [];
  levels.begin();
  let success = false, ended = '';
  while (!ended) {
    const seen = { ...task.observe(state), desired_goal: goal };
    const chosen = levels.act(seen, lesion);
    if (chosen.used > maxOptions) { ended = 'its action budget is used up'; break; }
    steps.push({ state: { ...state }, ...chosen });
    task.advance(state, chosen.action);
    success = task.reached(task.observe(state).achieved_goal, goal);
    if (success) ended = 'goal reached';
    else if (steps.length >= task.maxSteps) ended = 'time is up';
  }
  return { steps, last: { ...state }, success, ended, length: steps.length };
}

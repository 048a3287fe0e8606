'use strict';
// Episodes recorded by the Python task: the film, the path in the task's space, and what the low level saw at each step.
// The circuit still runs here: from the recorded inputs, with the lesion under which the episode was recorded.

function floats(text, columns) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0)), flat = new Float32Array(bytes.buffer), rows = [];
  for (let k = 0; k < flat.length; k += columns) rows.push(Array.from(flat.subarray(k, k + columns)));
  return rows;
}

/** Run the low level over a recorded episode. */
function replay(levels, episode, lesion) {
  const inputs = floats(episode.inputs, episode.n_inputs), places = floats(episode.places, 2), steps = [];
  let memory = new Float64Array(levels.low.remembers ? levels.low.size : 0);
  episode.options.forEach((option, number) => {
    for (let k = 0; k < option.duration; k++) {
      const t = option.start + k, fresh = t === 0 || (k === 0 && levels.p.memory === 'window');
      if (fresh || levels.p.memory === 'none') memory.fill(0);
      const { means, units } = levels.low.step(inputs[t], memory, lesion);
      if (levels.low.remembers) memory = Float64Array.from(units, Math.fround);
      steps.push({
        state: { place: places[t], step: t }, action: levels.squash(means), units, inputs: inputs[t], began: k === 0,
        left: option.time_budget - k, budget: option.time_budget, subgoal: option.subgoal, used: number + 1,
        mark: option.place, reached: option.reached,
      });
    }
  });
  const last = { place: places[steps.length], step: steps.length };
  return { steps, last, success: episode.success, ended: episode.ended, length: steps.length, places, film: episode.film };
}

/** The path so far with the goal, and the film's picture where there is one. */
class RecordedTask {
  constructor(data) {
    this.labels = data.space_labels;
    this.bounds = data.space_bounds;
    this.goalHelp = 'This task runs in a physics engine, so its episodes are recorded: goals cannot be dragged here.';
    this.pictures = new Map();
  }

  /** The film's picture for a step. */
  picture(film, step, changed) {
    if (!film || !film.frames.length) return null;
    const index = Math.min(film.frames.length - 1, Math.floor(step / film.every)), source = film.frames[index];
    if (!this.pictures.has(source)) {
      const image = new Image();
      image.onload = changed;
      image.src = 'data:image/jpeg;base64,' + source;
      this.pictures.set(source, image);
    }
    return this.pictures.get(source);
  }

  draw(pen, state, goalPlace, run, mark, changed) {
    const image = this.picture(run.film, state.step, changed);
    const path = (box) => this.path(pen, state, goalPlace, run, mark, box);
    if (image === null) return path([0, 0, 1, 1]);
    pen.image(image, run.film.shape);
    return path([0.66, 0.52, 0.34, 0.48]);
  }

  path(pen, state, goalPlace, run, mark, box) {
    const [x0, y0, x1, y1] = this.bounds;
    pen.inset(box, x0, y0, x1 - x0, y1 - y0);
    pen.curve(run.places, 'line', 1.2);
    pen.curve(run.places.slice(0, state.step + 1), 'ink', 2);
    if (goalPlace) pen.dot(goalPlace, 6, 'goal');
    if (mark) pen.dot(mark, 5, 'subgoal');
    pen.dot(state.place, 4.5, 'ink');
    pen.label(`${this.labels[0]} →, ${this.labels[1]} ↑`);
  }

  describe = (state) => `${this.labels[0]} ${state.place[0].toFixed(2)}, ${this.labels[1]} ${state.place[1].toFixed(2)}`;
}

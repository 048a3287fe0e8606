'use strict';
// The page: one episode on a time line, seen as a task, as a circuit and as traces; lesions and goals make a new one.

const DATA = JSON.parse(document.getElementById('data').textContent);
const $ = (id) => document.getElementById(id);

class App {
  constructor() {
    this.levels = new TwoLevels(DATA.policy);
    this.task = SIMULATED[DATA.live] || new RecordedTask(DATA);
    this.lesion = noLesion(DATA.names.length);
    Object.assign(this, { selected: null, index: 0, playing: false, whole: null });
    this.wires = this.levels.low.wires();
    this.taskPen = new Pen($('task'));
    this.diagram = new Diagram($('lines'), $('neurons'), DATA, (unit) => this.select(unit));
    this.strips = new Strips($('strips'), DATA, (share) => this.seek(Math.floor(share * this.run.steps.length)));
    this.fillStarts();
    this.bind();
    this.chooseStart(0);
    this.select(DATA.most_active);
    requestAnimationFrame((time) => this.frame(time));
  }

  // -- episodes ------------------------------------------------------------------------------------------------------

  fillStarts() {
    DATA.starts.forEach((start, k) => $('start').add(new Option(start.label, k)));
    $('random').hidden = DATA.live !== 'Pendulum';
  }

  chooseStart(k) {
    this.start = DATA.starts[k];
    this.goal = this.start.goal.slice();
    $('start').value = String(k);
    this.restart();
  }

  randomStart() {
    const angle = Math.PI / 4 + Math.random() * 1.5 * Math.PI;
    this.start = { label: 'random', state: { qpos: [angle], qvel: [0.1 * Math.random() - 0.05] } };
    const most = (16 / 180) * Math.PI;
    this.goal = [most * (2 * Math.random() - 1), 1.2 * Math.random() - 0.6];
    this.restart();
  }

  /** A new episode from the present start: without lesions for comparison, and with those there are. */
  restart() {
    this.whole = this.episode(noLesion(DATA.names.length));
    this.rerun();
    this.seek(0);
  }

  /** The same episode with the present lesions. */
  rerun() {
    const cut = this.lesion.held.some(Boolean);
    this.run = cut ? this.episode(this.lesion) : this.whole;
    this.ranges = DATA.names.map((_, i) => {
      const values = this.whole.steps.map((s) => s.units[i]);
      return [Math.min(...values), Math.max(...values)];
    });
    this.strips.paint(this.run, this.ranges);
    $('slider').max = this.run.steps.length - 1;
    this.index = Math.min(this.index, this.run.steps.length - 1);
    this.outcome(cut);
    this.dirty = true;
  }

  episode(lesion) {
    if (DATA.live) return simulate(this.levels, this.task, this.start.state, this.goal, lesion, DATA.max_options);
    const held = DATA.names.findIndex((_, i) => lesion.held[i]);
    return replay(this.levels, held < 0 ? this.start.whole : this.start.lesioned[held], lesion);
  }

  outcome(cut) {
    const say = (run) => (run.success ? `reached the goal after ${run.length} steps` : `did not reach the goal: ${run.ended}`);
    const held = DATA.names.filter((_, i) => this.lesion.held[i]);
    $('whole').textContent = `Whole: ${say(this.whole)}.`;
    $('lesioned').textContent = cut ? `With ${held.join(', ')} clamped: ${say(this.run)}.` : 'No neuron is lesioned.';
    $('lesioned').classList.toggle('worse', cut && this.whole.success && !this.run.success);
    const measured = held.length === 1 ? DATA.alone.filter((l) => l.unit === held[0]) : [];
    $('measured').textContent = measured.map((l) => `Over ${DATA.n_episodes} held-out episodes, clamped to its ` +
      `${l.clamped_to === 'rest' ? 'resting value' : 'mean'}: success ${(100 * l.success_rate).toFixed(0)} %.`).join(' ');
  }

  // -- time ----------------------------------------------------------------------------------------------------------

  seek(index) {
    this.index = Math.min(Math.max(index, 0), this.run.steps.length - 1);
    this.dirty = true;
  }

  play(on) {
    if (on && this.index >= this.run.steps.length - 1) this.seek(0);
    this.playing = on;
    $('play').textContent = on ? 'Pause' : 'Play';
    $('play').setAttribute('aria-pressed', on);
  }

  frame(time) {
    if (this.playing) {
      this.due = (this.due || 0) + Math.min(100, time - (this.shown || time)) * (DATA.steps_per_second / 1000) * $('speed').value;
      const steps = Math.floor(this.due);
      if (steps) { this.due -= steps; this.seek(this.index + steps); }
      if (this.index >= this.run.steps.length - 1) this.play(false);
    }
    this.shown = time;
    if (this.dirty) { this.dirty = false; this.draw(); }
    requestAnimationFrame((next) => this.frame(next));
  }

  // -- drawing -------------------------------------------------------------------------------------------------------

  draw() {
    const step = this.run.steps[this.index];
    this.taskPen.clear();
    if (DATA.live) this.task.draw(this.taskPen, step.state, this.goal, step.subgoal);
    else this.task.draw(this.taskPen, step.state, this.start.goal_place, this.run, step.mark, () => { this.dirty = true; });
    const currents = this.levels.low.currents(this.wires, step.inputs, step.units);
    this.diagram.show(step, this.wires, currents, this.ranges, this.lesion, this.selected);
    this.strips.show(this.run, this.index, this.selected);
    const share = Math.min(Math.max(step.left / DATA.policy.dt_max, 0), 1);
    $('budget').style.width = 100 * share + '%';
    $('time-left').textContent = `${Math.max(0, Math.ceil(step.left))} steps left for subgoal ${step.used}`;
    $('subgoal').textContent = DATA.subgoal_names.map((name, i) => `${name} ${step.subgoal[i].toFixed(2)}`).join(', ');
    $('state').textContent = this.task.describe(step.state);
    $('slider').value = this.index;
    $('slider').setAttribute('aria-valuetext', `step ${this.index}`);
    $('step').textContent = `step ${this.index} of ${this.run.steps.length - 1}`;
    this.drawNeuron(step, currents);
  }

  drawNeuron(step, currents) {
    const i = this.selected;
    if (i === null) return;
    const name = (k) => (k < 0 ? DATA.inputs[-1 - k] : DATA.names[k]);
    const heard = this.wires.map(([from, to], k) => [from, to, currents[k]]).filter((l) => l[1] === i);
    heard.sort((a, b) => Math.abs(b[2]) - Math.abs(a[2]));
    const lines = [['potential', step.units[i].toFixed(3)], ['this episode', this.ranges[i].map((x) => x.toFixed(2)).join(' to ')]];
    if (this.levels.low.timeConstants) lines.push(['time constant', this.levels.low.timeConstants(step.inputs, step.units)[i].toFixed(3) + ' steps']);
    lines.push(['weight on actions', DATA.readout[i].map((w) => w.toFixed(2)).join(', ') || 'not read']);
    lines.push(['hears most', heard.slice(0, 3).map((l) => `${name(l[0])} (${l[2] >= 0 ? '+' : '−'}${Math.abs(l[2]).toFixed(2)})`).join(', ') || 'nothing']);
    $('facts').replaceChildren(...lines.flatMap(([term, text]) => [make('dt', term), make('dd', text)]));
  }

  // -- neurons -------------------------------------------------------------------------------------------------------

  select(unit) {
    this.selected = unit;
    $('neuron').value = String(unit);
    const held = !!this.lesion.held[unit], offered = DATA.live || this.start.lesioned[unit];
    $('rest').disabled = $('mean').disabled = !offered;
    $('rest').hidden = !DATA.live && DATA.recorded_form !== 'rest';
    $('mean').hidden = !DATA.live && DATA.recorded_form !== 'mean';
    $('release').disabled = !held;
    $('unoffered').hidden = !!offered;
    this.dirty = true;
  }

  clamp(unit, form) {
    if (!DATA.live && !this.start.lesioned[unit]) return; // no episode was recorded with it
    if (!DATA.live) this.lesion = noLesion(DATA.names.length); // one recorded lesion at a time
    this.lesion.held[unit] = 1;
    this.lesion.value[unit] = DATA[form][unit];
    this.rerun();
    this.select(unit);
  }

  release(unit) {
    this.lesion.held[unit] = 0;
    this.rerun();
    this.select(unit);
  }

  releaseAll() {
    this.lesion = noLesion(DATA.names.length);
    this.rerun();
    this.select(this.selected);
  }

  // -- controls ------------------------------------------------------------------------------------------------------

  bind() {
    $('play').onclick = () => this.play(!this.playing);
    $('back').onclick = () => { this.play(false); this.seek(this.index - 1); };
    $('forward').onclick = () => { this.play(false); this.seek(this.index + 1); };
    $('slider').oninput = () => { this.play(false); this.seek(+$('slider').value); };
    $('start').onchange = () => this.chooseStart(+$('start').value);
    $('random').onclick = () => this.randomStart();
    DATA.names.forEach((name, k) => $('neuron').add(new Option(name, k)));
    $('neuron').onchange = () => this.select(+$('neuron').value);
    $('rest').onclick = () => this.clamp(this.selected, 'rest');
    $('mean').onclick = () => this.clamp(this.selected, 'mean');
    $('release').onclick = () => this.release(this.selected);
    $('release-all').onclick = () => this.releaseAll();
    $('theme').onclick = () => this.theme(document.documentElement.dataset.theme === 'dark' ? 'light' : 'dark');
    this.theme(matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light', true);
    addEventListener('resize', () => { this.dirty = true; });
    addEventListener('keydown', (e) => this.key(e));
    $('goal-help').textContent = this.task.goalHelp;
    if (DATA.live) this.bindGoal($('task'));
  }

  bindGoal(canvas) {
    let dragging = false;
    const move = (e) => {
      this.goal = this.task.goalAt(this.taskPen.toWorld(e.offsetX, e.offsetY), this.goal);
      this.whole = this.episode(noLesion(DATA.names.length));
      this.rerun();
    };
    canvas.addEventListener('pointerdown', (e) => { dragging = true; canvas.setPointerCapture(e.pointerId); move(e); });
    canvas.addEventListener('pointermove', (e) => dragging && move(e));
    canvas.addEventListener('pointerup', () => { dragging = false; });
    canvas.style.touchAction = 'none';
    canvas.style.cursor = 'grab';
  }

  key(e) {
    if (e.target.matches('select, input[type=range]') || e.ctrlKey || e.metaKey || e.altKey) return;
    const jump = e.shiftKey ? 10 : 1, actions = {
      ' ': () => this.play(!this.playing), ArrowLeft: () => this.seek(this.index - jump),
      ArrowRight: () => this.seek(this.index + jump), Home: () => this.seek(0), End: () => this.seek(Infinity),
      l: () => (this.lesion.held[this.selected] ? this.release(this.selected) : !$('rest').disabled &&
        this.clamp(this.selected, DATA.live ? 'rest' : DATA.recorded_form)),
      n: () => this.select((this.selected + 1) % DATA.names.length),
      p: () => this.select((this.selected + DATA.names.length - 1) % DATA.names.length),
    };
    const chosen = actions[e.key];
    if (!chosen || (e.key === ' ' && e.target.matches('button'))) return;
    e.preventDefault();
    chosen();
  }

  theme(name, early = false) {
    document.documentElement.dataset.theme = name;
    if (!early) { this.strips.paint(this.run, this.ranges); this.dirty = true; }
  }
}

function make(tag, text) {
  return Object.assign(document.createElement(tag), { textContent: text });
}

window.app = new App();

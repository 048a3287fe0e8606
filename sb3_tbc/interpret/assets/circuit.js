'use strict';
// The low level, one control step at a time: the same arithmetic as the agent's predict, with lesions.
// A lesion is {held, value}: units with held[i] keep value[i] through every sub-step.

const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/** An NDBC circuit with conductance dynamics; numbers as sb3_tbc.export.policy.Circuit has them. */
class ConductanceCircuit {
  constructor(numbers) {
    Object.assign(this, numbers);
    this.size = this.capacitance.length;
    this.remembers = true;
    this.driven = this.current_bias.length;
  }

  /** What stays the same over the sub-steps: sums of conductance times potential, then sums of conductance. */
  drive(inputs) {
    const n = this.size, scaled = inputs.map((u, i) => u * this.input_gain[i]);
    const sensed = this.sensory_gain.map((g, i) => sigmoid(scaled[i] * g - this.sensory_threshold[i]));
    const pulls = this.current_bias.map((b, m) => b + scaled.reduce((s, u, i) => s + u * this.current_weight[i][m], 0));
    const active = sensed.concat(pulls.map(Math.tanh));
    const total = Float64Array.from(this.rest);
    active.forEach((x, row) => {
      const weights = this.from_inputs[row];
      for (let k = 0; k < 2 * n; k++) total[k] += x * weights[k];
    });
    return { total, sensed, scaled, pulls };
  }

  step(inputs, state, lesion) {
    const n = this.size, pre = this.gain.length, { total } = this.drive(inputs);
    let v = Float64Array.from(state);
    const clamp = () => { for (let i = 0; i < n; i++) if (lesion.held[i]) v[i] = lesion.value[i]; };
    clamp();
    for (let sub = 0; sub < this.sub_steps; sub++) {
      const next = Float64Array.from(total);
      for (let j = 0; j < pre; j++) {
        const released = sigmoid(v[j] * this.gain[j] - this.threshold[j]), weights = this.recurrent[j];
        for (let k = 0; k < 2 * n; k++) next[k] += released * weights[k];
      }
      for (let i = 0; i < n; i++) {
        const pace = this.capacitance[i] * this.sub_steps;
        v[i] = (v[i] * pace + next[i]) / (next[n + i] + pace);
      }
      clamp();
    }
    return { means: readOut(this, v), units: v };
  }

  /** Who is wired to whom: [from, to] each; sensory neurons are "from" -1, -2, ... */
  wires() {
    const n = this.size, found = [], sensing = this.sensory_gain.length;
    for (let i = 0; i < this.input_gain.length; i++) {
      for (let j = 0; j < n; j++) {
        const senses = i < sensing && this.from_inputs[i][n + j] !== 0;
        if (senses || (j < this.driven && this.current_weight[i][j] !== 0)) found.push([-1 - i, j]);
      }
    }
    this.recurrent.forEach((row, i) => { for (let j = 0; j < n; j++) if (row[n + j] !== 0) found.push([i, j]); });
    return found;
  }

  /** Currents through the wires at potentials v. */
  currents(wires, inputs, v) {
    const n = this.size, { sensed, scaled, pulls } = this.drive(inputs), sensing = sensed.length;
    const released = this.gain.map((g, i) => sigmoid(v[i] * g - this.threshold[i]));
    const ratio = pulls.map((p) => (Math.abs(p) < 1e-6 ? 1 : Math.tanh(p) / p));
    return Float64Array.from(wires, ([from, j]) => {
      if (from >= 0) return released[from] * (this.recurrent[from][j] - this.recurrent[from][n + j] * v[j]);
      const i = -1 - from;
      let current = i < sensing ? sensed[i] * (this.from_inputs[i][j] - this.from_inputs[i][n + j] * v[j]) : 0;
      if (j < this.driven) current += this.from_inputs[sensing + j][j] * ratio[j] * scaled[i] * this.current_weight[i][j];
      return current;
    });
  }

  /** Effective time constants at potentials v, in control steps. */
  timeConstants(inputs, v) {
    const n = this.size, { total } = this.drive(inputs), sums = Float64Array.from(total.slice(n));
    for (let i = 0; i < this.gain.length; i++) {
      const released = sigmoid(v[i] * this.gain[i] - this.threshold[i]);
      for (let j = 0; j < n; j++) sums[j] += released * this.recurrent[i][n + j];
    }
    return sums.map((s, i) => this.capacitance[i] / s);
  }
}

/** A circuit with dissipative dynamics: x <- shrink (x + eta tanh(W u + U x + b)). */
class DissipativeCircuit {
  constructor(numbers) {
    Object.assign(this, numbers);
    this.size = this.bias.length;
    this.remembers = true;
  }

  step(inputs, state, lesion) {
    const n = this.size, drive = Float64Array.from(this.bias);
    inputs.forEach((u, i) => { for (let j = 0; j < n; j++) drive[j] += u * this.input_weight[i][j]; });
    let x = Float64Array.from(state);
    const clamp = () => { for (let i = 0; i < n; i++) if (lesion.held[i]) x[i] = lesion.value[i]; };
    clamp();
    for (let sub = 0; sub < this.sub_steps; sub++) {
      const force = Float64Array.from(drive);
      for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) force[j] += x[i] * this.recurrent[i][j];
      x = x.map((value, j) => this.shrink[j] * (value + this.eta * Math.tanh(force[j])));
      clamp();
    }
    return { means: readOut(this, x), units: x };
  }

  wires() {
    const found = [];
    this.input_weight.forEach((row, i) => row.forEach((w, j) => { if (w !== 0) found.push([-1 - i, j]); }));
    this.recurrent.forEach((row, i) => row.forEach((w, j) => { if (w !== 0) found.push([i, j]); }));
    return found;
  }

  currents(wires, inputs, x) {
    return Float64Array.from(wires, ([from, j]) =>
      (from < 0 ? inputs[-1 - from] * this.input_weight[-1 - from][j] : x[from] * this.recurrent[from][j]));
  }
}

/** A feed-forward low level; its units are the hidden units of all layers, one layer after the other. */
class FeedForward {
  constructor(numbers) {
    Object.assign(this, numbers);
    this.hidden = this.biases.slice(0, -1);
    this.size = this.hidden.reduce((n, b) => n + b.length, 0);
    this.remembers = false;
  }

  step(inputs, state, lesion) {
    let x = Array.from(inputs), start = 0;
    const units = new Float64Array(this.size);
    this.hidden.forEach((bias, layer) => {
      x = dense(x, this.weights[layer], bias).map((a) => (this.activation === 'relu' ? Math.max(a, 0) : Math.tanh(a)));
      x = x.map((a, i) => (lesion.held[start + i] ? lesion.value[start + i] : a));
      units.set(x, start);
      start += x.length;
    });
    return { means: dense(x, this.weights[this.hidden.length], this.biases[this.hidden.length]), units };
  }

  wires() {
    const found = [];
    let offset = null, start = 0;
    this.hidden.forEach((bias, layer) => {
      this.weights[layer].forEach((row, i) => row.forEach((_, j) => found.push([offset === null ? -1 - i : offset + i, start + j])));
      offset = start;
      start += bias.length;
    });
    this.strength = this.weights.slice(0, -1).flatMap((rows) => rows.flat());
    return found;
  }

  currents(wires, inputs, units) {
    return Float64Array.from(wires, ([from], k) => this.strength[k] * (from < 0 ? inputs[-1 - from] : units[from]));
  }
}

function dense(x, weights, bias) {
  return bias.map((b, j) => x.reduce((sum, value, i) => sum + value * weights[i][j], b));
}

function readOut(circuit, v) {
  return circuit.readout_bias.map((b, a) => circuit.readout.reduce((sum, row, i) => sum + row[a] * v[i], b));
}

function makeLow(numbers) {
  if (numbers.weights) return new FeedForward(numbers);
  return numbers.shrink ? new DissipativeCircuit(numbers) : new ConductanceCircuit(numbers);
}

function noLesion(size) {
  return { held: new Uint8Array(size), value: new Float64Array(size) };
}

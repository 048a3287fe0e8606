'use strict';
// The circuit as a picture: neurons light up by potential, synapses by current. Neurons are buttons.

const MOST_LINES = 400;
const SVG = 'http://www.w3.org/2000/svg';

class Diagram {
  constructor(canvas, svg, data, onSelect) {
    Object.assign(this, { pen: new Pen(canvas), svg, data, onSelect, nodes: [] });
    this.columns = [{ name: 'sensory', names: data.inputs, offset: null }];
    data.layers.forEach((l) => this.columns.push({ name: l.name, names: data.names.slice(l.start, l.stop), offset: l.start }));
    this.columns.push({ name: 'action', names: data.actions, offset: null, actions: true });
  }

  /** Put every neuron in its place; again when the size changes. */
  layout() {
    const box = this.svg.getBoundingClientRect();
    if (box.width === this.laidOut) return;
    this.laidOut = box.width;
    const data = this.data;
    const most = Math.max(...this.columns.map((c) => c.names.length));
    const height = Math.min(Math.max(230, 26 * most + 40), 560), narrow = box.width < 520;
    this.svg.style.height = this.pen.canvas.style.height = height + 'px';
    this.radius = Math.max(3, Math.min(9, (height - 50) / most / 2.4));
    this.places = new Map();
    this.svg.replaceChildren();
    this.nodes = [];
    const longest = Math.max(...data.inputs.map((name) => name.length));
    const left = data.inputs.length > 22 ? 40 : 20 + 6.3 * (narrow ? Math.min(longest, 9) : longest), right = narrow ? 26 : 50, last = this.columns.length - 1;
    this.columns.forEach((column, k) => {
      const x = left + ((box.width - left - right) * k) / last;
      this.label(x, 14, column.name, 'middle', 'head');
      column.names.forEach((name, i) => {
        const y = 30 + ((height - 40) * (i + 0.5)) / column.names.length;
        this.node(column, k, i, name, x, y, narrow);
      });
    });
  }

  node(column, k, i, name, x, y, narrow) {
    const key = column.actions ? 'a' + i : k === 0 ? -1 - i : column.offset + i;
    this.places.set(key, [x, y]);
    const crowded = column.names.length > 22;
    if (k === 0 && !crowded) this.label(x - this.radius - 5, y + 3.5, narrow && name.length > 9 ? shorten(name) : name, 'end', 'small');
    const shape = document.createElementNS(SVG, 'circle');
    Object.entries({ cx: x, cy: y, r: this.radius }).forEach(([a, v]) => shape.setAttribute(a, v));
    this.svg.append(shape);
    if (typeof key !== 'number' || key < 0) {
      this.nodes.push({ key, shape });
      return;
    }
    for (const [a, v] of Object.entries({ tabindex: 0, role: 'button', 'data-neuron': name, 'aria-label': name })) shape.setAttribute(a, v);
    shape.addEventListener('click', () => this.onSelect(key));
    shape.addEventListener('keydown', (e) => {
      if (e.key === 'Enter') { this.onSelect(key); e.preventDefault(); }
    });
    const title = document.createElementNS(SVG, 'title');
    title.textContent = name;
    shape.append(title);
    this.nodes.push({ key, shape });
  }

  label(x, y, words, anchor, kind) {
    const text = document.createElementNS(SVG, 'text');
    Object.entries({ x, y, 'text-anchor': anchor, class: kind }).forEach(([a, v]) => text.setAttribute(a, v));
    text.textContent = words;
    this.svg.append(text);
  }

  /** Show one step; ranges are each unit's lowest and highest value of the episode. */
  show(step, wires, currents, ranges, lesion, selected) {
    this.layout();
    this.pen.clear();
    this.lines(wires, currents, selected);
    this.nodes.forEach(({ key, shape }) => {
      const value = typeof key === 'string' ? step.action[+key.slice(1)] / this.data.policy.action_high[+key.slice(1)]
        : key < 0 ? step.inputs[-1 - key] / this.data.input_scale[-1 - key] : normalised(step.units[key], ranges[key]);
      shape.setAttribute('fill', potentialColour(value));
      shape.classList.toggle('selected', key === selected);
      shape.classList.toggle('held', key >= 0 && !!lesion.held[key]);
    });
  }

  lines(wires, currents, selected) {
    const c = this.pen.context, sizes = currents.map(Math.abs).sort(), largest = Math.max(1e-9, sizes[sizes.length - 1]);
    const least = sizes.length > MOST_LINES ? sizes[sizes.length - MOST_LINES] : 0;
    const reads = [];
    this.data.readout.forEach((row, i) => row.forEach((w, a) => { if (w !== 0) reads.push([i, 'a' + a, w]); }));
    const strongest = Math.max(1e-9, ...reads.map((l) => Math.abs(l[2])));
    c.strokeStyle = theme('muted');
    for (const [from, to, w] of reads.length > MOST_LINES ? [] : reads) this.stroke(from, to, 0.3 * Math.abs(w) / strongest, w < 0, selected);
    c.strokeStyle = theme('ink');
    wires.forEach(([from, to], k) => {
      const size = Math.abs(currents[k]);
      if (size >= least) this.stroke(from, to, size / largest, currents[k] < 0, selected);
    });
    c.setLineDash([]);
    c.globalAlpha = 1;
  }

  /** A line from one neuron to another: solid pulls the potential up, dashed down; the stronger the darker. */
  stroke(from, to, strength, down, selected) {
    const c = this.pen.context, a = this.places.get(from), b = this.places.get(to);
    if (!a || !b || strength < 0.02) return;
    const mine = selected !== null && (from === selected || to === selected);
    c.globalAlpha = Math.min(1, (mine ? 0.35 : 0.06) + 0.8 * strength);
    c.lineWidth = 0.6 + 3 * strength;
    c.setLineDash(down ? [5, 4] : []);
    c.beginPath();
    c.moveTo(...a);
    if (a[0] === b[0]) c.quadraticCurveTo(a[0] + 30, (a[1] + b[1]) / 2, ...b);
    else c.lineTo(...b);
    c.stroke();
  }
}

/** The beginning of each word, for narrow screens. */
function shorten(name) {
  return name.split(' ').map((word, k) => word.slice(0, k ? 3 : 4)).join(' ').slice(0, 10);
}

function normalised(value, [low, high]) {
  return high - low < 1e-9 ? 0 : (2 * (value - low)) / (high - low) - 1;
}

/** Potentials of all units over the whole episode, one row each, under one cursor. */
class Strips {
  constructor(canvas, data, onSeek) {
    Object.assign(this, { pen: new Pen(canvas), data, buffer: document.createElement('canvas') });
    const seek = (e) => onSeek((e.offsetX - this.left) / (canvas.getBoundingClientRect().width - this.left));
    canvas.addEventListener('pointerdown', (e) => { canvas.setPointerCapture(e.pointerId); this.dragging = true; seek(e); });
    canvas.addEventListener('pointermove', (e) => this.dragging && seek(e));
    canvas.addEventListener('pointerup', () => { this.dragging = false; });
    this.left = 74;
    this.rows = [];
    data.layers.forEach((l) => {
      for (let i = l.start; i < l.stop; i++) this.rows.push({ unit: i, head: i === l.start ? l.name : '' });
    });
    const tall = Math.max(4, Math.min(13, Math.floor(330 / this.rows.length)));
    this.tall = tall;
    canvas.style.height = this.rows.length * tall + 6 * data.layers.length + 24 + 'px';
  }

  /** Paint the whole episode once. */
  paint(run, ranges) {
    const n = run.steps.length, b = Object.assign(this.buffer, { width: n, height: this.rows.length }), c = b.getContext('2d');
    this.rows.forEach(({ unit }, y) => run.steps.forEach((s, x) => {
      c.fillStyle = potentialColour(normalised(s.units[unit], ranges[unit]));
      c.fillRect(x, y, 1, 1);
    }));
  }

  show(run, index, selected) {
    this.pen.clear();
    const c = this.pen.context, width = this.pen.width - this.left, n = run.steps.length;
    let y = 2;
    c.imageSmoothingEnabled = false;
    this.rows.forEach(({ unit, head }, row) => {
      if (head && row) y += 6;
      c.drawImage(this.buffer, 0, row, n, 1, this.left, y, width, this.tall - 1);
      c.font = `${unit === selected ? 'bold ' : ''}${Math.min(11, this.tall)}px system-ui, sans-serif`;
      c.fillStyle = theme(unit === selected ? 'ink' : 'muted');
      c.textAlign = 'right';
      if (this.tall > 8) c.fillText(this.data.names[unit], this.left - 6, y + this.tall - 3);
      else if (head) { c.font = '11px system-ui, sans-serif'; c.fillText(head, this.left - 6, y + 10); }
      y += this.tall;
    });
    c.fillStyle = theme('subgoal');
    run.steps.forEach((s, k) => { if (s.began) c.fillRect(this.left + (width * k) / n, y + 2, Math.max(1, width / n), 8); });
    c.fillStyle = theme('muted');
    c.font = '11px system-ui, sans-serif';
    c.fillText('new subgoal', this.left - 6, y + 10);
    c.fillStyle = theme('ink');
    c.fillRect(this.left + (width * (index + 0.5)) / n - 1, 0, 2, y + 12);
  }
}

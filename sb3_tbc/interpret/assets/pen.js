'use strict';
// Drawing on a canvas in a task's own units, in the colours of the page's theme.

const theme = (name) => getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim();

/** Blue at -1, grey at 0, red at 1: distinguishable with every common colour blindness. */
function potentialColour(x) {
  const stops = [[59, 76, 192], document.documentElement.dataset.theme === 'dark' ? [150, 153, 160] : [214, 214, 214],
    [180, 4, 38]];
  const at = Math.min(Math.max(x, -1), 1) + 1, k = at < 1 ? 0 : 1, share = at - k;
  return `rgb(${stops[k].map((c, i) => Math.round(c + share * (stops[k + 1][i] - c))).join(',')})`;
}

class Pen {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
  }

  /** Clear the canvas, in step with its size on the screen. */
  clear() {
    const ratio = window.devicePixelRatio || 1, box = this.canvas.getBoundingClientRect();
    const width = Math.round(box.width * ratio), height = Math.round(box.height * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    Object.assign(this, { width: box.width, height: box.height });
    this.context.clearRect(0, 0, this.width, this.height);
  }

  /** Show this part of the world, undistorted, y upwards. */
  world(left, bottom, width, height) {
    this.scale = Math.min(this.width / width, this.height / height);
    this.x0 = (this.width - this.scale * width) / 2 - this.scale * left;
    this.y0 = (this.height + this.scale * height) / 2 + this.scale * bottom;
    this.point = ([x, y]) => [this.x0 + this.scale * x, this.y0 - this.scale * y];
  }

  /** Show this part of the world, stretched into a share of the canvas. */
  inset([bx, by, bw, bh], left, bottom, width, height) {
    const margin = 16, w = bw * this.width - 2 * margin, h = bh * this.height - 2 * margin, c = this.context;
    const x0 = bx * this.width + margin, y0 = by * this.height + margin;
    if (bw < 1) {
      c.fillStyle = theme('panel');
      c.globalAlpha = 0.85;
      c.fillRect(x0 - margin / 2, y0 - margin / 2, w + margin, h + margin);
      c.globalAlpha = 1;
    }
    this.corner = [x0 - 4, y0 + h + 13];
    this.point = ([x, y]) => [x0 + (w * (x - left)) / width, y0 + h - (h * (y - bottom)) / height];
  }

  toWorld(px, py) {
    return [(px - this.x0) / this.scale, (this.y0 - py) / this.scale];
  }

  line(points, colour, width, alpha = 1) {
    this.curve(points, colour, Math.max(1, width * this.scale), alpha);
  }

  curve(points, colour, pixels, alpha = 1) {
    const c = this.context;
    Object.assign(c, { strokeStyle: theme(colour), lineWidth: pixels, globalAlpha: alpha, lineCap: 'round', lineJoin: 'round' });
    c.beginPath();
    points.forEach((p, k) => (k ? c.lineTo(...this.point(p)) : c.moveTo(...this.point(p))));
    c.stroke();
    c.globalAlpha = 1;
  }

  polygon(points, colour, alpha = 1) {
    const c = this.context;
    Object.assign(c, { fillStyle: theme(colour), globalAlpha: alpha });
    c.beginPath();
    points.forEach((p) => c.lineTo(...this.point(p)));
    c.fill();
    c.globalAlpha = 1;
  }

  box([x, y], [w, h], colour, alpha = 1) {
    this.polygon([[x, y], [x + w, y], [x + w, y + h], [x, y + h]], colour, alpha);
  }

  circle(centre, radius, colour, alpha = 1) {
    this.dot(centre, radius * this.scale, colour, alpha);
  }

  dot(centre, pixels, colour, alpha = 1) {
    const c = this.context;
    Object.assign(c, { fillStyle: theme(colour), globalAlpha: alpha });
    c.beginPath();
    c.arc(...this.point(centre), pixels, 0, 2 * Math.PI);
    c.fill();
    c.globalAlpha = 1;
  }

  text(words, at, colour) {
    Object.assign(this.context, { fillStyle: theme(colour), font: '12px system-ui, sans-serif', textAlign: 'center' });
    this.context.fillText(words, ...this.point(at));
  }

  label(words) {
    Object.assign(this.context, { fillStyle: theme('muted'), font: '11px system-ui, sans-serif', textAlign: 'left' });
    this.context.fillText(words, ...this.corner);
  }

  image(image, [width, height]) {
    const scale = Math.min(this.width / width, this.height / height), w = width * scale, h = height * scale;
    if (image.complete && image.naturalWidth) this.context.drawImage(image, 0, 0, w, h);
  }
}

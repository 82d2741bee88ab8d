// Drawing of one scene on a canvas, seen from above; metres to pixels.
import { kinematics } from './physics.js';

const HALF = 0.265; // metres from the shoulder to the edge

export const toShare = ([x, y]) => [0.5 + x / (2 * HALF), 0.5 - y / (2 * HALF)];
export const fromShare = ([a, b]) => [(a - 0.5) * 2 * HALF, (0.5 - b) * 2 * HALF];

/** Colours of the page, as the style sheet has them for light and dark. */
export function palette(element) {
  const style = getComputedStyle(element), colour = name => style.getPropertyValue(`--${name}`).trim();
  return Object.fromEntries(['ground', 'wall', 'faint', 'ink', 'object', 'obstacle', 'target', 'executed', 'bent'].map(name => [name, colour(name)]));
}

export class View {
  constructor(canvas) {
    Object.assign(this, { canvas, context: canvas.getContext('2d'), size: 0 });
  }

  /** Fit the canvas to its place on the screen. */
  fit() {
    const size = Math.round(this.canvas.clientWidth * Math.min(3, globalThis.devicePixelRatio || 1));
    if (size && size !== this.canvas.width) this.canvas.width = this.canvas.height = size;
    this.size = this.canvas.width;
  }

  at(point) {
    return toShare(point).map(v => v * this.size);
  }

  metres(v) {
    return v / (2 * HALF) * this.size;
  }

  clear(colours, { task, arm }) {
    const { context: c, size } = this;
    c.globalAlpha = 1;
    c.setLineDash([]);
    c.fillStyle = colours.ground;
    c.fillRect(0, 0, size, size);
    c.lineCap = c.lineJoin = 'round';
    if (task === 'push') {
      c.strokeStyle = colours.wall;
      c.lineWidth = this.metres(0.006);
      const [x, y] = this.at([-arm.wall - 0.003, arm.wall + 0.003]), wide = this.metres(2 * arm.wall + 0.006);
      c.strokeRect(x, y, wide, wide);
    } else {
      c.strokeStyle = colours.faint;
      c.lineWidth = this.metres(0.002);
      this.circle([0, 0], arm.links[0] + arm.links[1]);
      c.stroke();
    }
  }

  circle(point, radius) {
    this.context.beginPath();
    this.context.arc(...this.at(point), this.metres(radius), 0, 2 * Math.PI);
  }

  goal(point, colour, halo) {
    const { context: c } = this;
    for (const [paint, more] of [[halo, 0.003], [colour, 0]]) { // the halo sets it off from the object
      c.strokeStyle = c.fillStyle = paint;
      c.lineWidth = this.metres(0.003 + more);
      this.circle(point, 0.013);
      c.stroke();
      this.circle(point, 0.004 + more / 2);
      c.fill();
    }
  }

  /** A line through points (n, 2) of an array with ``stride`` numbers each, from ``first`` on. */
  path(values, count, stride, first, colour, width, alpha = 1, begin = null) {
    const { context: c } = this;
    c.globalAlpha = alpha;
    c.strokeStyle = colour;
    c.lineWidth = this.metres(width);
    c.beginPath();
    if (begin) c.moveTo(...this.at(begin));
    for (let k = 0; k < count; k++) {
      const point = this.at([values[k * stride + first], values[k * stride + first + 1]]);
      if (k || begin) c.lineTo(...point);
      else c.moveTo(...point);
    }
    c.stroke();
    c.globalAlpha = 1;
  }

  block(point, radius, colour, { outline = false, dashed = false, alpha = 1 } = {}) {
    const { context: c } = this;
    c.globalAlpha = alpha;
    c.setLineDash(dashed ? [this.metres(0.006), this.metres(0.007)] : []);
    this.circle(point, outline ? radius - 0.0015 : radius);
    if (outline) {
      c.strokeStyle = colour;
      c.lineWidth = this.metres(0.003);
      c.stroke();
    } else {
      c.fillStyle = colour;
      c.fill();
    }
    c.setLineDash([]);
    c.globalAlpha = 1;
  }

  /** Both links from joint angles: filled, or as an outline. */
  arm(angles, { links, radius }, colour, { outline = false, alpha = 1, ground = '#fff' } = {}) {
    const { context: c } = this, [elbow, tip] = kinematics(angles, links);
    const stroke = (paint, width) => {
      c.strokeStyle = paint;
      c.lineWidth = this.metres(width);
      c.beginPath();
      [[0, 0], elbow, tip].forEach((point, i) => (i ? c.lineTo(...this.at(point)) : c.moveTo(...this.at(point))));
      c.stroke();
    };
    c.globalAlpha = alpha;
    stroke(colour, 2 * radius);
    if (outline) stroke(ground, 2 * radius - 0.006);
    c.globalAlpha = 1;
    c.fillStyle = outline ? colour : ground;
    for (const joint of [[0, 0], elbow]) {
      this.circle(joint, 0.0035);
      c.fill();
    }
  }
}

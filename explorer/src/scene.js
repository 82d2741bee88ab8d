// A scene: what a person chose, and the link that restores it. Geometry as in tsmlib.envs.geometry.
import { kinematics } from './physics.js';

const SPACES = ['latent', 'direct'];
const DEFAULTS = {
  push: { arm: [2.5, 1.2], block: [-0.02, 0.13], target: [0.09, 0.1] },
  obstacle: { arm: [0, 0], block: [0.08, 0.12], target: [-0.06, 0.15] },
  reach: { arm: [0, 0], block: null, target: [-0.06, 0.15] },
};

export function defaultScene(task = 'push') {
  const { arm, block, target } = DEFAULTS[task];
  return { task, model: 'rtsm', space: 'latent', replan: false, seed: 1, arm: [...arm], block: block && [...block], target: [...target] };
}

/** State (dx) in which the scene starts: at rest. */
export function startState({ task, arm, block }, { links }) {
  const [, tip] = kinematics(arm, links);
  return task === 'reach' ? [...arm, 0, 0, ...tip] : [...arm, 0, 0, ...tip, ...block, 0, 0];
}

function toSegment([x, y], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay], share = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)));
  return Math.hypot(x - ax - share * dx, y - ay - share * dy);
}

/** Metres between the arm's surface and the block's; negative where they overlap. */
export function gap(arm, block, { links, radius, block: size }) {
  const [elbow, tip] = kinematics(arm, links);
  return Math.min(toSegment(block, [0, 0], elbow), toSegment(block, elbow, tip)) - radius - size;
}

/** Joint angles that bring the fingertip as near to a point as it gets, bent to the same side as before. */
export function reachFor([x, y], before, { links: [a, b], elbow }) {
  const distance = Math.min(a + b, Math.max(b - a, Math.hypot(x, y)));
  const cosine = (distance ** 2 - a ** 2 - b ** 2) / (2 * a * b);
  const bend = Math.min(elbow - 0.05, Math.acos(Math.min(1, Math.max(-1, cosine)))) * (before[1] < 0 ? -1 : 1);
  const first = Math.atan2(y, x) - Math.atan2(b * Math.sin(bend), a + b * Math.cos(bend));
  return [Math.atan2(Math.sin(first), Math.cos(first)), bend];
}

/** The scene with one thing moved, or the same where it cannot be there: in the arm, in a wall, out of reach. */
export function moved(scene, what, point, arm) {
  const limit = arm.wall - arm.block, found = { ...scene };
  if (what === 'target') {
    const far = Math.hypot(...point), most = arm.links[0] + arm.links[1];
    found.target = scene.task === 'push' ? point.map(v => Math.min(limit, Math.max(-limit, v)))
      : point.map(v => v * Math.min(1, most / Math.max(far, 1e-9)));
  } else if (what === 'block') {
    found.block = point.map(v => Math.min(limit, Math.max(-limit, v)));
  } else {
    found.arm = reachFor(point, scene.arm, arm);
  }
  const free = !found.block || gap(found.arm, found.block, arm) >= arm.clearance;
  return free ? found : scene;
}

/** The scene with the elbow bent to the other side, where there is room. */
export function flipped(scene, arm) {
  const [, tip] = kinematics(scene.arm, arm.links), found = { ...scene, arm: reachFor(tip, [0, scene.arm[1] < 0 ? 1 : -1], arm) };
  return !found.block || gap(found.arm, found.block, arm) >= arm.clearance ? found : scene;
}

/** What of a scene lies outside the starts and targets that the training and test data are drawn from, in words. */
export function outside({ task, arm, block, target }, { start, target: ring }) {
  const cm = v => Number((100 * v).toFixed(1)), degrees = v => Math.round(v * 180 / Math.PI), found = []; // judged as printed
  const distance = (what, point, ends) => {
    const [far, low, high] = [Math.hypot(...point), ...ends].map(cm);
    if (far < low || far > high) found.push(`the ${what} is ${far.toFixed(1)} cm from the shoulder (${low.toFixed(1)} to ${high.toFixed(1)} in the data)`);
  };
  distance('target', target, ring);
  if (block) distance(task === 'push' ? 'object' : 'obstacle', block, start.block);
  ['shoulder', 'elbow'].forEach((joint, i) => {
    const [angle, most] = [arm[i], start.angles[i]].map(degrees);
    if (Math.abs(angle) > most) found.push(`the ${joint} starts at ${angle}° (within ±${most}° in the data)`);
  });
  return found;
}

/** The part of a link that says the scene. */
export function toLink({ task, model, space, replan, seed, arm, block, target }) {
  const short = values => values.map(v => Number(v.toFixed(4))).join(',');
  const parts = { task, model, space, replan: replan ? 1 : 0, seed, arm: short(arm), target: short(target) };
  if (block) parts.block = short(block);
  return `#${Object.entries(parts).map(([key, value]) => `${key}=${value}`).join('&')}`;
}

/** The scene that a link says, or what is wrong with the link in one sentence: { scene, problem }. */
export function fromLink(link, manifest) {
  const given = new URLSearchParams(link.replace(/^#/, '')), task = given.get('task') ?? 'push';
  const wrong = what => ({ scene: defaultScene(), problem: `This link cannot be restored: ${what}. Here is the first scene instead.` });
  if (!Object.hasOwn(manifest.tasks, task)) return wrong(`it names a task that is none of ${Object.keys(manifest.tasks).join(', ')}`);
  const scene = defaultScene(task), { models, target: ring } = manifest.tasks[task], { arm } = manifest;
  const model = given.get('model') ?? scene.model, space = given.get('space') ?? scene.space;
  if (!Object.hasOwn(models, model)) return wrong(`it names a model that is none of ${Object.keys(models).join(', ')}`);
  if (!SPACES.includes(space)) return wrong('its search space is neither latent nor direct');
  const seed = Number(given.get('seed') ?? 1);
  if (!Number.isInteger(seed) || seed < 0 || seed > 1e9) return wrong('its seed is no whole number from 0 to 1,000,000,000');
  const found = { ...scene, model, space, seed, replan: given.get('replan') === '1' };
  const places = ['arm', 'target', ...(task === 'reach' ? [] : ['block'])];
  for (const name of places) {
    if (!given.has(name)) continue;
    const values = given.get(name).split(',').map(text => (text.trim() === '' ? NaN : Number(text)));
    if (values.length !== 2 || !values.every(Number.isFinite)) return wrong(`its ${name} is not two numbers`);
    found[name] = values;
  }
  const limit = arm.wall - arm.block + 1e-6, most = arm.links[0] + arm.links[1] + 1e-6;
  if (Math.abs(found.arm[0]) > Math.PI + 1e-3 || Math.abs(found.arm[1]) > arm.elbow) return wrong('the arm does not bend that far');
  if (task === 'push' ? found.target.some(v => Math.abs(v) > limit) : Math.hypot(...found.target) > most) return wrong('its target is out of reach');
  if (found.block && found.block.some(v => Math.abs(v) > limit)) return wrong('its object lies outside the walls');
  if (found.block && gap(found.arm, found.block, arm) < 0) return wrong('its object overlaps the arm');
  return { scene: found, problem: '' };
}

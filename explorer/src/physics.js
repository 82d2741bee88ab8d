// The true arm: MuJoCo in WebAssembly, from MJCF and the numbers that its six digits do not give.
import { PageError, read } from './files.js';

export async function loadMujoco(factory, options = {}) {
  try {
    return await factory(options);
  } catch {
    throw new PageError('MuJoCo did not start in this browser; open the page in a newer Firefox, Chrome or Safari.');
  }
}

/** Position of elbow and fingertip of joint angles. */
export function kinematics([first, second], [a, b]) {
  const elbow = [a * Math.cos(first), a * Math.sin(first)];
  return [elbow, [elbow[0] + b * Math.cos(first + second), elbow[1] + b * Math.sin(first + second)]];
}

export class World {
  static async load(mujoco, about, task, links, reader = read) {
    const model = mujoco.MjModel.from_xml_string(new TextDecoder().decode(await reader(about.file)));
    for (const [name, values] of Object.entries(about.exact)) model[name]?.set(values);
    return new World(mujoco, model, about.substeps, task, links);
  }

  constructor(mujoco, model, substeps, task, links) {
    Object.assign(this, { mujoco, model, substeps, task, links, data: new mujoco.MjData(model) });
  }

  /** Put the arm, at rest or not, into a state (dx). */
  reset(x) {
    const { mujoco, model, data, task } = this;
    mujoco.mj_resetData(model, data);
    const block = task === 'push';
    data.qpos.set([x[0], x[1], ...(block ? [x[6], x[7]] : [])]);
    data.qvel.set([x[2], x[3], ...(block ? [x[8], x[9]] : [])]);
    if (task === 'obstacle') data.mocap_pos.set([x[6], x[7], 0.01]);
  }

  /** States (T, dx) after each of T steps under actions (T, 2), float64. */
  advance(actions) {
    const { mujoco, model, data, task, links } = this, found = [];
    for (let t = 0; 2 * t < actions.length; t++) {
      data.ctrl.set([actions[2 * t], actions[2 * t + 1]]);
      for (let s = 0; s < this.substeps; s++) mujoco.mj_step(model, data);
      const q = data.qpos, v = data.qvel, [, tip] = kinematics(q, links);
      const rest = { push: [q[2], q[3], v[2], v[3]], obstacle: [data.mocap_pos[0], data.mocap_pos[1], 0, 0], reach: [] }[task];
      found.push(q[0], q[1], v[0], v[1], ...tip, ...rest);
    }
    return Float64Array.from(found);
  }
}

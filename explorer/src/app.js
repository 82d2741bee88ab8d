// The page: what a person does, the worker's answers, and the drawing of both.
import { LESSONS, TOUR } from './lessons.js';
import { drawStrip, drawTorques } from './plot.js';
import { kinematics } from './physics.js';
import { defaultScene, flipped, fromLink, moved, outside, startState, toLink } from './scene.js';
import { View, fromShare, palette, toShare } from './view.js';

const $ = id => document.getElementById(id);
const TASKS = { push: 'push the object to the target', obstacle: 'reach past an obstacle', reach: 'reach the target' };
const SPACES = { latent: 'codes c', direct: 'any torques' };
const MODELS = { rtsm: 'recurrent TSM', tsm: 'TSM', lstm: 'LSTM', onestep: 'one-step model' };
const STEP = 0.005, LONG_STEP = 0.02; // metres per key
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const LAST = 20; // tries in the strip
const WAYS = [{ model: 'rtsm', space: 'latent' }, { model: 'onestep', space: 'direct' }]; // each try is made by two: ours, or what was chosen, and the other
const OPENING = 2; // scene of the tour: the fooled model
const SAME = 6; // tries in the table
const WAIT = 200; // ms from a choice or a key to the plan, in case that more follow
const LABEL = 0.05; // m from what can be dragged to its name
const FOOLED = 1; // cm, by which the mean distance to the target may differ from the prediction
const still = matchMedia('(prefers-reduced-motion: reduce)'), dark = matchMedia('(prefers-color-scheme: dark)');
const signed = (v, digits = 2) => v.toFixed(digits).replace('-', '−');

const state = {
  manifest: null, scene: defaultScene(), result: null, time: 0, playing: false, planning: false, failed: false,
  view: matchMedia('(max-width: 700px)').matches ? 'over' : 'beside', tries: [], bent: null, tour: -1, id: 0, waiting: 0, touched: false, opening: false,
};
const worker = new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
const views = { predicted: new View($('predicted')), executed: new View($('executed')) };

const about = () => state.manifest.tasks[state.scene.task];
const horizon = () => about().horizon;
const look = word => about().models[word];

/** A model's colour, lighter on a dark page. */
function colourOf(word) {
  const { colour } = look(word);
  return dark.matches ? `color-mix(in oklab, ${colour} 45%, white)` : colour;
}

/** The same as numbers that a canvas takes. */
function painted(colour) {
  const probe = $('swatch');
  probe.style.background = colour;
  return getComputedStyle(probe).backgroundColor;
}

/** Where a state has the position of what has to arrive. */
const placeOf = task => (task === 'push' ? 6 : 4);

// Drawing ---------------------------------------------------------------------------------------------------------------

let drawn = 0;
function redraw() {
  drawn ||= requestAnimationFrame(() => { drawn = 0; if (state.manifest) draw(); });
}

/** State at a step of the predicted rollout that was current then, and of the execution; the start at step 0. */
function statesAt(time) {
  const { parts, executed, dx } = state.result, start = startState(state.scene, state.manifest.arm);
  const at = (values, k) => Array.from(values.subarray(k * dx, (k + 1) * dx));
  if (!time) return { predicted: start, executed: start, part: parts[0] };
  const part = parts.findLast(({ from }) => from < time), known = Math.min(time, executed.length / dx);
  return { predicted: at(part.predicted, time - part.from - 1), executed: known ? at(executed, known - 1) : start, part };
}

function draw() {
  const { scene, result, time } = state, { arm } = state.manifest, colours = palette(document.body);
  const model = painted(colourOf(scene.model)), start = startState(scene, arm);
  const now = result?.parts.length ? statesAt(time) : { predicted: start, executed: start, part: null };
  const over = state.view === 'over', place = placeOf(scene.task);
  for (const [name, view] of Object.entries(views)) {
    if (over && name === 'executed') continue;
    view.fit();
    view.clear(colours, { task: scene.task, arm });
    const predicted = over || name === 'predicted', executed = over || name === 'executed';
    if (time) {
      view.arm(scene.arm, arm, colours.wall, { alpha: 0.35, ground: colours.ground });
      if (scene.block) view.block(scene.block, arm.block, colours.wall, { outline: true, dashed: true });
    }
    if (now.part && predicted) trails(view, now, model, place, time);
    if (now.part && executed) {
      view.path(result.executed, Math.min(time, result.executed.length / result.dx), result.dx, place, colours.executed, 0.003, 0.9, [start[place], start[place + 1]]);
    }
    const block = scene.task === 'push' ? colours.object : colours.obstacle;
    const draws = {
      executed: () => {
        if (scene.block) view.block(now.executed.slice(6, 8), arm.block, block);
        view.arm(now.executed, arm, colours.executed, { ground: colours.ground });
      },
      predicted: () => {
        if (scene.block) view.block(now.predicted.slice(6, 8), arm.block, over ? model : block, { outline: over });
        view.arm(now.predicted, arm, model, { outline: over, ground: colours.ground });
      },
    };
    if (executed) draws.executed();
    if (predicted) draws.predicted();
    if (state.bent && predicted) {
      const { from, states } = state.bent, dx = result.dx, k = Math.max(0, Math.min(states.length / dx, time - from) - 1);
      view.path(states, states.length / dx, dx, place, colours.bent, 0.004);
      view.path([0, 0, ...kinematics(states.subarray(k * dx, k * dx + 2), arm.links).flat()], 3, 2, 0, colours.bent, 0.004);
      if (scene.task === 'push') view.block(states.subarray(k * dx + 6, k * dx + 8), arm.block, colours.bent, { outline: true });
    }
    view.goal(scene.target, colours.target, colours.ground);
  }
  placeHandles();
}

/** The fan, and the path of what has to arrive as the current plan predicts it, to the end. */
function trails(view, { part }, colour, place, time) {
  const { dx, parts, executed } = state.result, steps = part.predicted.length / dx;
  const begin = ({ from }) => Array.from(from ? executed.slice((from - 1) * dx + place) : startState(state.scene, state.manifest.arm).slice(place)).slice(0, 2);
  const [x, y] = begin(part);
  for (const earlier of parts.filter(({ from }) => from < part.from)) { // what each plan before this one predicted
    view.path(earlier.predicted, earlier.predicted.length / dx, dx, place, colour, 0.002, 0.35, begin(earlier));
    view.block(begin(earlier), 0.004, colour);
  }
  if (part.fan) {
    for (let s = 0; s < part.fan.length / steps / 2; s++) {
      view.path(part.fan.subarray(s * steps * 2, (s + 1) * steps * 2), steps, 2, 0, colour, 0.0013, 0.3, [x, y]);
    }
  }
  view.path(part.predicted, time ? time - part.from : steps, dx, place, colour, 0.003, 0.9, [x, y]);
}

// Handles: buttons over the scene, for pointer, touch and keys ----------------------------------------------------------

const NAMES = { target: 'Target', block: 'Object', arm: 'Fingertip' };
const handles = [];

function makeHandles() {
  for (const [figure, reachable] of [['figure-predicted', true], ['figure-executed', false]]) {
    for (const what of Object.keys(NAMES)) {
      const button = document.createElement('button');
      Object.assign(button, { type: 'button', className: `handle ${what}`, tabIndex: reachable ? 0 : -1 });
      button.dataset.what = what;
      if (!reachable) button.setAttribute('aria-hidden', 'true');
      $(figure).querySelector('.frame').append(button);
      button.addEventListener('pointerdown', grab);
      button.addEventListener('keydown', push);
      if (what === 'arm') button.addEventListener('dblclick', flip);
      handles.push(button);
    }
  }
}

function position(what) {
  return what === 'arm' ? kinematics(state.scene.arm, state.manifest.arm.links)[1] : state.scene[what];
}

/** Whether a name has more room below its handle than above. */
function roomBelow([x, y], others) {
  const room = up => Math.min(...others.map(([a, b]) => Math.hypot((a - x) / 2, b - y - up))); // names are wide
  return room(-LABEL) > room(LABEL);
}

function placeHandles() {
  const near = Object.keys(NAMES).map(position).filter(Boolean), { result, scene } = state;
  if (result?.done) { // the path, and the arm at its end
    const path = scene.replan ? result.executed : result.parts[0].predicted, { dx } = result, place = placeOf(scene.task);
    for (let i = 4 * dx; i < path.length; i += 5 * dx) near.push(path.subarray(i + place, i + place + 2));
    near.push(...kinematics(path.slice(-dx), state.manifest.arm.links));
  }
  for (const handle of handles) {
    const { what } = handle.dataset, point = position(what);
    handle.hidden = !point;
    if (!point) continue;
    delete handle.dataset.name;
    const [a, b] = toShare(point), cm = point.map(v => signed(100 * v, 1));
    handle.style.left = `${100 * a}%`;
    handle.style.top = `${100 * b}%`;
    const name = what === 'block' && state.scene.task === 'obstacle' ? 'Obstacle' : NAMES[what];
    handle.setAttribute('aria-label', `${name} at ${cm[0]}, ${cm[1]} cm; arrow keys move it${what === 'arm' ? ', F bends the elbow the other way' : ''}`);
    handle.title = what === 'arm' ? 'Fingertip at the start: drag it, or double-click to bend the elbow the other way' : `${name}: drag it`;
    if (state.touched || handle.tabIndex) continue;
    const below = roomBelow(point, near.filter(other => String(other) !== String(point)));
    Object.assign(handle.dataset, { name: name.toLowerCase(), side: below ? 'below' : 'above' });
    near.push([point[0], point[1] + (below ? -LABEL : LABEL)]);
  }
}

function grab(event) {
  const handle = event.currentTarget, { what } = handle.dataset, frame = handle.parentElement;
  event.preventDefault();
  handle.focus({ preventScroll: true });
  handle.setPointerCapture(event.pointerId);
  state.touched = true;
  let changed = false;
  const follow = ({ clientX, clientY }) => {
    const box = frame.getBoundingClientRect();
    changed = change(moved(state.scene, what, fromShare([(clientX - box.left) / box.width, (clientY - box.top) / box.height]), state.manifest.arm)) || changed;
  };
  const release = () => {
    handle.removeEventListener('pointermove', follow);
    if (changed) plan();
  };
  handle.addEventListener('pointermove', follow);
  handle.addEventListener('pointerup', release, { once: true });
  handle.addEventListener('pointercancel', release, { once: true });
}

function push(event) {
  const { what } = event.currentTarget.dataset, direction = KEYS[event.key], { arm } = state.manifest;
  if (what === 'arm' && event.key.toLowerCase() === 'f') flip();
  if (!direction) return;
  event.preventDefault();
  const far = event.shiftKey ? LONG_STEP : STEP;
  state.touched = true;
  if (change(moved(state.scene, what, position(what).map((v, i) => v + far * direction[i]), arm))) planSoon();
}

function flip() {
  state.touched = true;
  if (change(flipped(state.scene, state.manifest.arm))) planSoon();
}

/** Take a scene where it is another one; what was planned for the one before is gone. */
function change(scene) {
  if (scene === state.scene) return false;
  if (state.opening) { // the line above the picture says so
    state.opening = false;
    if (scene.model === state.scene.model && scene.space === state.scene.space) scene = { ...scene, ...WAYS[0], replan: true };
    worker.postMessage({ type: 'load', task: scene.task, model: scene.model });
  }
  state.scene = scene;
  forget();
  show();
  return true;
}

function forget() {
  worker.postMessage({ type: 'stop' });
  clearTimeout(state.waiting);
  Object.assign(state, { waiting: 0, result: null, bent: null, time: 0, playing: false, planning: false });
  for (const knob of [0, 1]) $(`knob-${knob}`).value = 0;
}

// What the page says ----------------------------------------------------------------------------------------------------

function show() {
  const { scene, result, planning } = state, done = result?.done, model = look(scene.model);
  $('do').textContent = headline();
  $('task').value = scene.task;
  $('model').value = scene.model;
  $('space').value = scene.space;
  $('replan').checked = scene.replan;
  $('plan').disabled = planning || state.failed;
  $('plan').textContent = done ? 'Plan with new random numbers' : 'Plan';
  $('plan').title = done ? 'Plan the same scene again: the planner draws its candidates with other random numbers' : '';
  $('views').dataset.view = state.view;
  for (const button of document.querySelectorAll('[data-set-view]')) button.setAttribute('aria-pressed', String(button.dataset.setView === state.view));
  $('caption-predicted').textContent = state.view === 'over' ? `Outline: ${MODELS[scene.model]}. Solid: MuJoCo` : `Predicted by the ${MODELS[scene.model]}`;
  $('caption-executed').textContent = scene.replan ? 'Executed by MuJoCo, planning every ten steps' : 'Executed by MuJoCo without looking (open loop)';
  $('time').max = horizon();
  $('time').disabled = $('play').disabled = !result?.parts.length;
  $('time').value = state.time;
  $('play').textContent = state.playing ? '❚❚' : '▶';
  $('play').setAttribute('aria-label', state.playing ? 'Pause' : 'Play');
  $('clock').textContent = `${(state.time * state.manifest.dt).toFixed(2)} s`;
  $('time').setAttribute('aria-valuetext', $('clock').textContent);
  const marks = outside(scene, about());
  $('outside').hidden = !marks.length;
  $('outside').textContent = marks.length ? `Outside the training data: ${marks.join('; ')}. The model may be wrong there.` : '';
  $('outcome').setAttribute('aria-busy', String(planning)); // a screen reader waits for the outcome
  $('numbers').hidden = $('agreement').hidden = $('meaning').hidden = !done;
  $('legend').textContent = legend();
  if (done) {
    $('predicted-return').textContent = signed(done.predicted);
    $('executed-return').textContent = signed(done.executed);
    $('gap').textContent = gapOf(done);
    $('distance').textContent = `${(100 * done.distance).toFixed(1)} cm`;
  }
  $('verdict').className = `verdict ${done ? (done.success ? 'good' : 'bad') : ''}`;
  $('verdict').textContent = verdict();
  $('agreement').className = `agreement ${done && fooled(done) ? 'fooled' : ''}`;
  $('agreement').textContent = done ? agreement() : '';
  $('meaning').textContent = `Return: minus the distance to the target (m) and squared torques, summed over ${horizon()} steps; 0 is best. Gap: predicted minus executed.`;
  drawTorques($('torques'), result?.parts.length ? result.parts[0].actions : []);
  showTries();
  const knobs = model.knobs, usable = knobs.length > 0 && done && !scene.replan;
  $('knobs').disabled = !usable;
  [0, 1].forEach(k => {
    $(`knob-name-${k}`).innerHTML = `<var>z</var><sub>${knobs.length ? knobs[k] + 1 : ''}</sub>`;
    $(`knob-value-${k}`).textContent = signed(Number($(`knob-${k}`).value), 1);
  });
  $('knob-hint').textContent = knobs.length ? turned() : `The ${MODELS[scene.model]} has no code: it predicts one future.`;
  history.replaceState(null, '', toLink(scene));
  redraw();
}

/** The one line above the picture. */
function headline() {
  if (state.opening) return 'A one-step model planned this push, fooled by its own prediction. Drag the red target: a recurrent TSM plans.';
  return 'Drag the target, the object or the fingertip. Each try is planned both ways: see the strip below.';
}

/** What is drawn, in words. */
function legend() {
  const { scene } = state, what = { push: ' Brown: the object.', obstacle: ' Grey disc: the obstacle.', reach: '' }[scene.task];
  const fan = look(scene.model).knobs.length ? `Thick line: Z = 0, by which the plan was chosen. Thin: 32 futures of the ${mover(scene.task)}, each with a random Z.` : 'No thin lines: this model gives one future.';
  return `Red ring: the target.${what} Pale and dashed: the start. ${fan}${scene.replan ? ' Dots: where it planned again; faint lines: what those plans predicted.' : ''}`;
}

/** What the knobs do. */
function turned() {
  if (state.scene.replan) return 'For a plan that is made once: untick “Plan again every ten steps”.';
  return `Another Z, another future of the same torques, in purple. These are two of its eight numbers; the planner does not search them.`;
}

function verdict() {
  const { scene, result, planning } = state, done = result?.done;
  if (planning && result?.parts.length === 1) {
    const { round } = result.parts[0], searched = (state.progress?.round ?? round) + 1;
    return `Best of ${searched} ${searched === 1 ? 'search' : 'searches'} so far; it searches on until nothing gets better.`;
  }
  if (planning && result?.parts.length) {
    const { candidates, iterations, ms } = result.parts.at(-1);
    return `Executing and planning again: ${candidates} × ${iterations} candidates in ${Math.round(ms)} ms.`;
  }
  if (planning || state.waiting) return state.progress ? `Planning: iteration ${state.progress.iteration} of ${state.progress.of}, ${signed(state.progress.value, 1)} predicted so far.` : 'Planning…';
  if (!done) return scene.task === 'push' ? 'Drag the target, the object or the fingertip; or press Plan.' : 'Drag the target or the fingertip; or press Plan.';
  return `${done.success ? 'Arrived' : 'Missed'}: ${(100 * done.distance).toFixed(1)} cm off target (limit ${Math.round(100 * about().tolerance)} cm)`;
}

/** What has to arrive. */
const mover = task => (task === 'push' ? 'object' : 'fingertip');

/** How much farther (cm) from the target it was executed than predicted, in the mean over time: both spent the same torques. */
const farther = ({ predicted, executed, replan, steps }) => (replan ? 0 : 100 * (predicted - executed) / steps);
const fooled = one => farther(one) > FOOLED;

/** Prediction against execution, in words. */
function agreement() {
  const { scene, result: { done } } = state, cm = farther(done), much = `${Math.abs(cm).toFixed(1)} cm`;
  if (scene.replan) return 'Planned again every ten steps, from what the arm really did. The predicted return is that of the first plan.';
  const what = `on average the ${mover(scene.task)} was ${much} ${cm > 0 ? 'farther from' : 'nearer to'} the target than predicted`;
  if (fooled(done)) return `The model was fooled: ${what}.`;
  return cm < -FOOLED ? `The model was too pessimistic: ${what}.` : `Model and execution agree: ${what}.`;
}

/** What of a scene stays the same when another model or another search is tried. */
const startOf = ({ task, arm, block, target }) => toLink({ task, arm, block, target, model: '', space: '', replan: false, seed: 0 });

/** The table of tries from the start on the screen, the latest first. */
function showTries() {
  const start = startOf(state.scene), same = state.tries.filter(one => one.start === start).slice(-SAME).reverse();
  $('tries').replaceChildren(...same.map(one => {
    const row = document.createElement('tr'), swatch = document.createElement('span');
    const cell = (text, className = '') => Object.assign(row.insertCell(), { textContent: text, className });
    Object.assign(swatch, { className: 'swatch' }).style.background = colourOf(one.model);
    cell(MODELS[one.model]).prepend(swatch);
    cell(`${SPACES[one.space]}${one.replan ? ', again every ten steps' : ''}`);
    cell(signed(one.predicted));
    cell(signed(one.executed));
    cell(`${gapOf(one)}${fooled(one) ? ' fooled' : ''}`, fooled(one) ? 'fooled' : '');
    cell(`${(100 * one.distance).toFixed(1)} cm`);
    return row;
  }));
  $('fooled').textContent = `${same.length ? '' : 'None yet. '}Fooled: open loop, the ${mover(state.scene.task)} was on average over ${FOOLED} cm farther from the target than predicted.`;
}

/** The gap of the returns as they are printed. */
const gapOf = ({ predicted, executed }) => signed(Number(predicted.toFixed(2)) - Number(executed.toFixed(2)));

// Time ------------------------------------------------------------------------------------------------------------------

/** Steps that have been executed so far: while it plans again, the page can play no further. */
const reached = () => (state.result ? state.result.executed.length / state.result.dx : 0);

function play() {
  if (state.time >= horizon()) state.time = 0;
  state.playing = true;
  let last = performance.now(), share = 0;
  const result = state.result;
  const frame = now => {
    if (!state.playing || state.result !== result) return;
    share += Math.max(0, now - last) / 1000 / state.manifest.dt;
    last = now;
    const steps = Math.floor(share), next = Math.min(reached(), state.time + steps);
    share = next === reached() ? 0 : share - steps;
    if (next !== state.time) state.time = next;
    if (state.time >= horizon()) state.playing = false;
    else requestAnimationFrame(frame);
    tick();
  };
  requestAnimationFrame(frame);
  show();
}

/** What changes with time alone. */
function tick() {
  $('time').value = state.time;
  $('clock').textContent = `${(state.time * state.manifest.dt).toFixed(2)} s`;
  if (!state.playing) show();
  redraw();
}

function scrub() {
  state.playing = false;
  state.time = Math.min(Number($('time').value), reached());
  show();
}

// Planning --------------------------------------------------------------------------------------------------------------

function plan() {
  forget();
  state.id += 1;
  Object.assign(state, { planning: true, progress: null, result: { parts: [], executed: new Float64Array(0), dx: about().stateDim, done: null } });
  worker.postMessage({ type: 'plan', id: state.id, live: !still.matches, scene: { ...state.scene, start: startState(state.scene, state.manifest.arm) } });
  show();
}

/** Plan when a person has chosen; not for each of several choices or keys in a row. */
function planSoon() {
  clearTimeout(state.waiting);
  state.waiting = setTimeout(plan, WAIT);
  show();
}

/** Another try from the same start: other random numbers. */
function tryAgain() {
  if (state.result?.done) change({ ...state.scene, seed: state.scene.seed + 1 });
  plan();
}

function fail(message) {
  Object.assign(state, { planning: false, failed: true });
  $('notice').hidden = false;
  $('notice').textContent = message;
  $('verdict').textContent = 'The page cannot plan.';
  $('plan').disabled = true;
}

const answers = {
  ready({ manifest }) {
    state.manifest = manifest;
    start();
  },
  loaded() {
    const first = !document.body.dataset.ready;
    document.body.dataset.ready = 'yes';
    if (first && !state.result) plan();
  },
  error({ message }) {
    fail(message);
  },
  progress(event) {
    state.progress = event;
    if (state.result.parts.length < 2) $('verdict').textContent = verdict();
  },
  part(part) {
    const { result } = state, better = !part.from && result.parts.length, before = part.from ? result.executed : new Float64Array(0);
    const executed = new Float64Array(before.length + part.executed.length);
    executed.set(before);
    executed.set(part.executed, before.length);
    Object.assign(result, { executed, parts: [...(part.from ? result.parts : []), part] });
    if (part.from) $('verdict').textContent = verdict();
    else if (still.matches || (better && state.playing)) show();
    else play();
  },
  done(done) {
    const { result, scene } = state, { model, space, replan } = scene;
    result.done = { ...done, replan, steps: horizon() };
    state.planning = false;
    if (still.matches) state.time = horizon();
    state.tries = [...state.tries, { ...result.done, id: state.id, model, space, start: startOf(scene) }].slice(-LAST);
    plot();
    show();
    const other = WAYS.find(way => way.model !== model || way.space !== space);
    worker.postMessage({ type: 'plan', id: state.id, live: !still.matches, rival: true, scene: { ...scene, ...other, start: startState(scene, state.manifest.arm) } });
  },
  rival(rival) {
    const one = state.tries.find(({ id }) => id === rival.id);
    if (one) one.rival = { ...rival, steps: one.steps, replan: one.replan };
    plot();
  },
  imagined({ from, states }) {
    asked = false;
    if (wanted) turn();
    const turned = [0, 1].some(k => Number($(`knob-${k}`).value));
    state.bent = turned && state.result ? { from, states } : null;
    redraw();
  },
};

/** The strip of the last tries, and how often either way arrived. */
function plot() {
  const hued = one => one && { ...one, colour: colourOf(one.model) }, limit = about().tolerance;
  drawStrip($('returns'), state.tries.map(one => ({ ...hued(one), rival: hued(one.rival) })), { limit, most: LAST });
  const pairs = state.tries.filter(({ rival }) => rival).flatMap(one => [one, one.rival]), counts = new Map();
  for (const { model, space, success } of pairs) {
    const name = `${MODELS[model]}, ${SPACES[space]}`, [arrived, all] = counts.get(name) ?? [0, 0];
    counts.set(name, [arrived + success, all + 1]);
  }
  const said = [...counts].map(([name, [arrived, all]]) => `${name} ${arrived} of ${all}`).join('; ');
  $('share').textContent = said ? `Within ${Math.round(100 * limit)} cm: ${said}.` : 'Each try is made both ways, from the same start with the same search.';
}

let asked = false, wanted = false;

/** Ask for the future under the knobs; one question at a time. */
function turn() {
  wanted = asked;
  if (asked) return;
  asked = true;
  const values = [0, 1].map(k => Number($(`knob-${k}`).value));
  worker.postMessage({ type: 'imagine', id: state.id, knobs: look(state.scene.model).knobs, values });
}

worker.onmessage = ({ data }) => {
  if ('id' in data && data.id !== state.id) return;
  if ('id' in data && !state.result) return;
  answers[data.type](data);
};
worker.onerror = () => fail('The planner did not start: this browser lacks module workers or WebAssembly; open the page in a newer Firefox, Chrome or Safari.');

// Tour and links --------------------------------------------------------------------------------------------------------

function restore(link) {
  const { scene, problem } = fromLink(link, state.manifest);
  $('notice').hidden = !problem;
  $('notice').textContent = problem;
  forget();
  state.scene = scene;
  options();
  show();
  worker.postMessage({ type: 'load', task: scene.task, model: scene.model });
}

function visit(k) {
  state.tour = k;
  const place = TOUR[k];
  $('guide').hidden = !place;
  state.opening = false;
  $('tour').hidden = $('do').hidden = Boolean(place);
  $('steps').hidden = !place;
  if (!place) {
    $('tour').focus();
    return;
  }
  $('guide-title').textContent = `Scene ${k + 1} of ${TOUR.length}: ${place.title}`;
  $('guide-text').textContent = place.text;
  $('guide-back').disabled = k === 0;
  $('guide-next').disabled = k + 1 === TOUR.length;
  $('guide-title').focus({ preventScroll: true });
  $('guide').scrollIntoView({ block: 'nearest', behavior: still.matches ? 'auto' : 'smooth' });
  restore(place.link);
  plan();
}

function options() {
  const fill = (id, entries) => $(id).replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
  fill('task', Object.keys(state.manifest.tasks).map(task => [task, TASKS[task]]));
  fill('model', Object.keys(about().models).map(word => [word, { tsm: 'TSM (the paper’s)', rtsm: 'recurrent TSM (ours)' }[word] ?? MODELS[word]]));
}

function copyLink() {
  const said = $('link').textContent, url = location.href;
  const told = text => { $('link').textContent = text; setTimeout(() => { $('link').textContent = said; }, 1500); };
  if (!navigator.clipboard) return told('The address bar has it');
  return navigator.clipboard.writeText(url).then(() => told('Copied'), () => told('The address bar has it'));
}

function start() {
  makeHandles();
  state.opening = !location.hash;
  restore(location.hash || TOUR[OPENING].link);
  plot();
  const choose = key => event => {
    if (key === 'task') change({ ...defaultScene(event.target.value), model: state.scene.model, space: state.scene.space, replan: state.scene.replan });
    else change({ ...state.scene, [key]: key === 'replan' ? event.target.checked : event.target.value });
    worker.postMessage({ type: 'load', task: state.scene.task, model: state.scene.model });
    planSoon();
    const { bottom, height } = $('views').getBoundingClientRect(); // on a narrow screen the choices are below the picture
    if (bottom < height / 2) $('views').scrollIntoView({ block: 'start', behavior: still.matches ? 'auto' : 'smooth' });
  };
  for (const key of ['task', 'model', 'space', 'replan']) $(key).addEventListener('change', choose(key));
  $('plan').addEventListener('click', tryAgain);
  $('play').addEventListener('click', () => { if (state.playing) { state.playing = false; show(); } else play(); });
  $('time').addEventListener('input', scrub);
  for (const knob of [0, 1]) $(`knob-${knob}`).addEventListener('input', () => { state.touched = true; show(); turn(); });
  for (const button of document.querySelectorAll('[data-set-view]')) {
    button.addEventListener('click', () => { state.view = button.dataset.setView; show(); });
  }
  $('link').addEventListener('click', copyLink);
  $('tour').addEventListener('click', () => visit(0));
  $('guide-back').addEventListener('click', () => visit(state.tour - 1));
  $('guide-next').addEventListener('click', () => visit(state.tour + 1));
  $('guide-end').addEventListener('click', () => visit(-1));
  addEventListener('hashchange', () => { restore(location.hash); plan(); });
  dark.addEventListener('change', () => { plot(); show(); });
  new ResizeObserver(redraw).observe($('views'));
}

$('lessons').innerHTML = LESSONS.map(({ title, math, text }) => `<article><h2>${title}</h2>${math}<p>${text}</p></article>`).join('');

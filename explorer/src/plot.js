// Returns of the last tries, and the torques of a plan, as SVG.
const NS = 'http://www.w3.org/2000/svg', SIZE = 260, LEFT = 48, BELOW = 42, TOP = 8;

function element(name, attributes, text = '') {
  const found = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) found.setAttribute(key, value);
  found.textContent = text;
  return found;
}

/** tries: { predicted, executed, colour, space, replan }, oldest first; the last one is emphasised. */
export function drawReturns(svg, tries) {
  const values = tries.flatMap(({ predicted, executed }) => [predicted, executed]);
  const low = Math.floor(Math.min(-10, ...values) / 5) * 5, high = Math.ceil(Math.max(-5, ...values) / 5) * 5;
  const wide = SIZE - LEFT - 8, tall = SIZE - BELOW - TOP;
  const x = v => LEFT + (v - low) / (high - low) * wide, y = v => TOP + (high - v) / (high - low) * tall;
  svg.replaceChildren();
  svg.setAttribute('viewBox', `0 0 ${SIZE} ${SIZE}`);
  svg.append(element('path', { d: `M${x(low)} ${y(low)}H${x(high)}V${y(high)}Z`, class: 'fooled' }));
  const step = high - low > 20 ? 10 : 5;
  for (let v = low; v <= high; v += step) {
    svg.append(
      element('path', { d: `M${x(v)} ${TOP}V${TOP + tall}M${LEFT} ${y(v)}H${LEFT + wide}`, class: 'grid' }),
      element('text', { x: x(v), y: TOP + tall + 20, 'text-anchor': 'middle' }, `${v}`.replace('-', '−')),
      element('text', { x: LEFT - 6, y: y(v) + 4, 'text-anchor': 'end' }, `${v}`.replace('-', '−')),
    );
  }
  svg.append(
    element('path', { d: `M${x(low)} ${y(low)}L${x(high)} ${y(high)}`, class: 'equal' }),
    ...['predicted more', 'than executed'].map((text, i) =>
      element('text', { x: LEFT + wide - 6, y: y(low) - 22 + 14 * i, 'text-anchor': 'end', class: 'note' }, text)),
    element('text', { x: LEFT + wide / 2, y: SIZE - 4, 'text-anchor': 'middle' }, 'predicted return'),
    element('text', { x: 0, y: 0, 'text-anchor': 'middle', transform: `translate(11 ${TOP + tall / 2}) rotate(-90)` }, 'executed return'),
  );
  tries.forEach(({ predicted, executed, colour, space }, i) => {
    const last = i + 1 === tries.length, r = last ? 6 : 4, mark = { class: last ? 'try last' : 'try', style: `--colour:${colour}` };
    const [a, b] = [x(predicted), y(executed)];
    svg.append(space === 'latent' ? element('circle', { cx: a, cy: b, r, ...mark })
      : element('rect', { x: a - r, y: b - r, width: 2 * r, height: 2 * r, ...mark }));
  });
  const below = tries.filter(({ predicted, executed }) => predicted > executed).length;
  svg.setAttribute('aria-label', tries.length
    ? `Predicted against executed return of the last ${tries.length} tries; ${below} predicted more than was executed.`
    : 'Predicted against executed return; no tries yet.');
}

/** actions: torques (T, 2) of shoulder and elbow, each from -1 to 1. */
export function drawTorques(svg, actions) {
  const steps = actions.length / 2;
  svg.replaceChildren(element('path', { d: 'M0 24H360', class: 'grid' }), ...[0, 1].map(joint => element('path', {
    class: 'torque', d: Array.from({ length: steps }, (_, t) => `${t ? 'L' : 'M'}${360 * t / (steps - 1)} ${24 - 55 * actions[2 * t + joint]}`).join(''),
  })));
}

// Where the last tries ended, and the torques of a plan, as SVG.
const NS = 'http://www.w3.org/2000/svg', SIZE = 260, LEFT = 48, BELOW = 42, TOP = 8;

function element(name, attributes, text = '') {
  const found = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) found.setAttribute(key, value);
  found.textContent = text;
  return found;
}

/**
 * Where the last tries ended, one column each: the way that was chosen, filled, and the other, hollow.
 * tries: { distance, colour, space, rival: { distance, colour, space } or none }, oldest first. limit: metres that count as arrived.
 */
export function drawStrip(svg, tries, { limit, most }) {
  const high = 0.25, wide = SIZE - LEFT - 8, tall = SIZE - BELOW - TOP;
  const x = i => LEFT + (i + 0.5) * wide / most, y = v => TOP + (1 - Math.min(v, high) / high) * tall;
  svg.replaceChildren(element('rect', { x: LEFT, y: y(limit), width: wide, height: y(0) - y(limit), class: 'arrived' }));
  svg.setAttribute('viewBox', `0 0 ${SIZE} ${SIZE}`);
  for (let cm = 0; cm <= 25; cm += 5) {
    svg.append(
      element('path', { d: `M${LEFT} ${y(cm / 100)}H${LEFT + wide}`, class: 'grid' }),
      element('text', { x: LEFT - 6, y: y(cm / 100) + 4, 'text-anchor': 'end' }, cm === 25 ? '≥25' : `${cm}`),
    );
  }
  svg.append(
    element('text', { x: LEFT + wide / 2, y: SIZE - 14, 'text-anchor': 'middle' }, 'tries, the latest on the right'),
    element('text', { x: 0, y: 0, 'text-anchor': 'middle', transform: `translate(11 ${TOP + tall / 2}) rotate(-90)` }, 'cm from the target at the end'),
  );
  const mark = ({ distance, colour, space }, i, kind, r) => {
    const [a, b] = [x(i), y(distance)], style = `--colour:${colour}`;
    return space === 'latent' ? element('circle', { cx: a, cy: b, r, class: kind, style })
      : element('rect', { x: a - r, y: b - r, width: 2 * r, height: 2 * r, class: kind, style });
  };
  tries.forEach((one, i) => {
    if (one.rival) svg.append(element('path', { d: `M${x(i)} ${y(one.distance)}V${y(one.rival.distance)}`, class: 'grid' }), mark(one.rival, i, 'rival', 4));
    svg.append(mark(one, i, i + 1 === tries.length ? 'try last' : 'try', 4.5));
  });
  const arrived = tries.filter(({ distance }) => distance < limit).length;
  svg.setAttribute('aria-label', tries.length ? `Distance from the target at the end of the last ${tries.length} tries, both ways; ${arrived} arrived as chosen.` : 'Distance from the target at the end; no tries yet.');
}

/** actions: torques (T, 2) of shoulder and elbow, each from -1 to 1. */
export function drawTorques(svg, actions) {
  const steps = actions.length / 2;
  svg.replaceChildren(element('path', { d: 'M0 24H360', class: 'grid' }), ...[0, 1].map(joint => element('path', {
    class: 'torque', d: Array.from({ length: steps }, (_, t) => `${t ? 'L' : 'M'}${360 * t / (steps - 1)} ${24 - 55 * actions[2 * t + joint]}`).join(''),
  })));
}

// Chromium for test/page.mjs, measure.mjs and look.mjs: traces, and what axe-core finds.
import { readFileSync } from 'node:fs';
import { chromium } from 'playwright-core';

const axe = readFileSync(new URL('../node_modules/axe-core/axe.min.js', import.meta.url), 'utf8');
const RULES = ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa', 'best-practice'];

export const launch = () => chromium.launch({
  executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: ['--no-sandbox', '--disable-gpu'],
});
export const slow = { timeout: 120000 };
export const ready = page => page.waitForSelector('body[data-ready=yes]', slow);
export const planned = page => page.waitForFunction(() => !document.querySelector('#numbers').hidden, null, slow);

/** Begin to trace; what is returned ends it and gives CPU times (ms): of the page's longest task, and of each worker. */
export async function tracing(page) {
  const session = await page.context().newCDPSession(page), events = [];
  session.on('Tracing.dataCollected', ({ value }) => events.push(...value));
  const done = new Promise(resolve => { session.on('Tracing.tracingComplete', resolve); });
  await session.send('Tracing.start', { traceConfig: { includedCategories: ['toplevel', 'devtools.timeline', 'disabled-by-default-devtools.timeline', '__metadata'] } });
  return async () => {
    await session.send('Tracing.end');
    await done;
    const tasks = word => events.filter(({ name, args }) => name === 'thread_name' && args.name.startsWith(word)).map(thread =>
      events.filter(({ ph, pid, tid, name }) => ph === 'X' && name === 'RunTask' && pid === thread.pid && tid === thread.tid).map(({ tdur = 0 }) => tdur / 1000));
    return { longest: Math.max(0, ...tasks('CrRendererMain').flat()), workers: tasks('DedicatedWorker').map(times => times.reduce((a, b) => a + b, 0)) };
  };
}

/** Violations on a page as it is now: [rule, elements]. */
export async function violations(page) {
  await page.evaluate(axe);
  const found = await page.evaluate(rules => axe.run(document, { runOnly: rules }), RULES);
  return found.violations.map(({ id, nodes }) => [id, nodes.map(node => node.html)]);
}

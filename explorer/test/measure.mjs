// node test/measure.mjs URL: times, sizes and accessibility of the page in Chromium, as JSON for measure.py.
import { gzipSync } from 'node:zlib';
import { launch, planned, ready, slow, tracing, violations } from './browser.mjs';

const LOADS = 5, PLANS = 10;
const [url] = process.argv.slice(2), browser = await launch();
const median = values => [...values].sort((a, b) => a - b)[Math.floor(values.length / 2)];

/** Keep the events of the planner, type 'part', in window.parts. */
function listen() {
  window.parts = [];
  window.Worker = class extends Worker {
    constructor(...given) {
      super(...given);
      this.addEventListener('message', ({ data }) => data.type === 'part' && window.parts.push(data));
    }
  };
}

async function open(options = {}, link = '') {
  const page = await browser.newPage({ viewport: { width: 1440, height: 900 }, ...options });
  await page.addInitScript(listen);
  page.bodies = new Map();
  page.on('response', answer => page.bodies.set(answer.url(), answer.body().catch(() => ''))); // '': the page is closed
  await page.goto(url + link);
  await ready(page);
  return page;
}

async function loads() {
  const times = [];
  let size = 0;
  for (let k = 0; k < LOADS; k++) {
    const page = await open();
    times.push(await page.evaluate(() => performance.now()));
    size = 0;
    for (const body of page.bodies.values()) size += gzipSync(await body, { level: 9 }).length;
    await page.close();
  }
  return { loads: LOADS, ready_ms: median(times), gzip_bytes: size };
}

async function plan(page) {
  await page.click('#plan');
  await page.waitForFunction(() => document.querySelector('#numbers').hidden, null, slow);
  await planned(page);
}

async function plans() {
  const page = await open();
  await planned(page);
  const end = await tracing(page);
  for (let k = 0; k < PLANS; k++) {
    await plan(page);
    await page.waitForFunction(() => document.querySelector('#time').value === '100', null, slow);
  }
  const { longest, workers } = await end(), times = await page.evaluate(() => window.parts.map(({ ms }) => ms));
  await page.close();
  return { plans: times.length, plan_ms: median(times), plan_least_ms: Math.min(...times), longest_task_ms: longest, plan_cpu_ms: Math.max(...workers) / PLANS };
}

async function replans() {
  const page = await open({}, '#replan=1');
  for (let k = 0; k < PLANS; k++) await plan(page);
  const parts = await page.evaluate(() => window.parts.filter(({ from }) => from).map(({ ms, candidates, iterations }) => ({ ms, search: `${candidates} x ${iterations}` })));
  const searches = parts.map(({ search }) => search).sort();
  const [least, most] = [searches[0], searches.at(-1)];
  await page.close();
  const times = parts.map(({ ms }) => ms), within = times.filter(ms => ms <= 200).length / times.length;
  return { replans: times.length, replan_ms: median(times), replan_within_200_ms: within, replan_searches: least === most ? least : `${least} to ${most}` };
}

async function accessibility() {
  let found = 0, looked = 0;
  for (const width of [390, 1440]) {
    for (const colorScheme of ['light', 'dark']) {
      const page = await open({ viewport: { width, height: 900 }, colorScheme, reducedMotion: 'reduce' });
      await planned(page);
      for (const go of [async () => {}, () => page.click('#tour')]) {
        await go();
        found += (await violations(page)).length;
        looked += 1;
      }
      await page.close();
    }
  }
  return { violations: found, looked_at: looked };
}

const measured = { ...await loads(), ...await plans(), ...await replans(), ...await accessibility() };
await browser.close();
console.log(JSON.stringify(measured));

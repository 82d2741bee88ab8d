// node test/page.mjs URL [FOLDER]: the page in Chromium as a person uses it. Prints what was measured as JSON.
// FOLDER: for pictures. Exit status 1 and a message where something is not as it should be.
import assert from 'node:assert/strict';
import { launch, planned, ready, slow, tracing, violations } from './browser.mjs';

const [url, folder] = process.argv.slice(2), measured = {};
const browser = await launch();

async function open(link = '', options = {}, before = async () => {}) {
  const page = await browser.newPage({ viewport: { width: 1440, height: 900 }, ...options });
  page.errors = [];
  page.on('console', message => message.type() === 'error' && page.errors.push(message.text()));
  page.on('pageerror', error => page.errors.push(error.message));
  await before(page);
  await page.goto(url + link);
  return page;
}
const text = (page, selector) => page.textContent(selector);
const afresh = page => page.waitForFunction(() => document.querySelector('#numbers').hidden, null, slow);
const below = (page, selector) => page.locator(selector).boundingBox().then(({ y, height }) => y + height);
const tries = page => page.locator('#returns .try').count();

async function onFirstScreen(page, selectors) {
  for (const one of selectors) assert.ok(await below(page, one) <= 900, `${one} is not on the first screen`);
}

async function accessible(page, what) {
  assert.deepEqual(await violations(page), [], `axe-core: ${what}`);
}

const only = process.env.ONLY ?? '';
const steps = {
  async 'a person drags the target and sees plan and execution'() {
    const page = await open();
    await ready(page);
    measured.ready_ms = Math.round(await page.evaluate(() => performance.now()));
    await planned(page);
    await onFirstScreen(page, ['#do', '#space', '#knob-hint', '#verdict', '#numbers', '#meaning', '#agreement', '#time', '#legend']);
    assert.match(await text(page, '#agreement'), /The model was fooled/);
    const trace = await tracing(page);
    const box = await page.locator('#predicted').boundingBox(), handle = await page.locator('#figure-predicted .handle.target').boundingBox();
    const at = [handle.x + 22, handle.y + 22];
    await page.mouse.move(...at);
    await page.mouse.down();
    await page.mouse.move(at[0] - 0.05 * box.width, at[1] + 0.02 * box.height, { steps: 5 });
    await page.mouse.up();
    await planned(page);
    assert.match(await text(page, '#caption-predicted'), /recurrent TSM/);
    assert.match(await text(page, '#caption-executed'), /every ten steps/);
    const [predicted, executed] = await Promise.all(['#predicted-return', '#executed-return'].map(id => text(page, id)));
    assert.ok([predicted, executed].every(value => Number(value.replace('−', '-')) < 0), `${predicted} ${executed}`);
    assert.equal(await tries(page), 2);
    await page.waitForFunction(() => document.querySelector('#time').value === '100', null, slow);
    measured.longest_main_thread_task_cpu_ms = (await trace()).longest;
    await page.waitForFunction(() => document.querySelectorAll('#returns .rival').length > 0, null, slow); // made the other way too
    assert.match(await text(page, '#share'), /Within 5 cm: .*recurrent TSM, codes c \d of \d/);
    await page.locator('#time').fill('40');
    assert.equal(await text(page, '#clock'), '0.80 s');
    await page.uncheck('#replan');
    await afresh(page);
    await planned(page);
    await page.locator('#knob-0').fill('2');
    assert.equal(await text(page, '#knob-value-0'), '2.0');
    await page.click('[data-set-view=over]');
    assert.equal(await page.locator('#figure-executed').isVisible(), false);
    await accessible(page, '1440 px, light');
    if (folder) await page.screenshot({ path: `${folder}/overlaid.png` });
    assert.deepEqual(page.errors, []);
    await page.close();
  },

  async 'it plans again every ten steps'() {
    const page = await open('#replan=1');
    await ready(page);
    await planned(page);
    assert.match(await text(page, '#agreement'), /Planned again every ten steps/);
    assert.deepEqual(page.errors, []);
    await page.close();
  },

  async 'model, search space and task are switched'() {
    const page = await open('#task=push');
    await ready(page);
    await planned(page);
    const choose = async (id, value) => { // and nothing else: it plans by itself
      await page.selectOption(id, value);
      await afresh(page);
      await planned(page);
    };
    await choose('#model', 'onestep');
    await choose('#space', 'direct');
    assert.deepEqual(await page.locator('#tries td:first-child').allTextContents(), ['one-step model', 'one-step model', 'recurrent TSM']);
    assert.match(await text(page, '#caption-predicted'), /one-step/);
    assert.equal(await page.locator('#returns rect.try').count(), 1);
    assert.equal(await page.locator('#knob-0').isDisabled(), true);
    assert.match(await text(page, '#legend'), /this model gives one future/);
    for (const [task, model] of [['obstacle', 'lstm'], ['reach', 'tsm']]) {
      await choose('#task', task);
      await choose('#model', model);
    }
    assert.equal(await page.locator('#tries tr').count(), 2); // another start
    await page.evaluate(() => { // two choices in a row are one plan
      for (const [id, value] of [['model', 'lstm'], ['space', 'latent']]) {
        document.getElementById(id).value = value;
        document.getElementById(id).dispatchEvent(new Event('change'));
      }
    });
    await afresh(page);
    await planned(page);
    await page.click('#plan'); // the same start with another seed
    await afresh(page);
    await planned(page);
    assert.equal(await tries(page), 9);
    assert.match(page.url(), /seed=2/);
    assert.deepEqual(page.errors, []);
    await page.close();
  },

  async 'a link restores the scene, and keys move it'() {
    const link = '#task=push&model=tsm&space=direct&replan=1&seed=3&arm=1,-1.5&target=-0.1,-0.12&block=-0.12,0.06';
    const page = await open(link, { reducedMotion: 'reduce' });
    await ready(page);
    assert.deepEqual(await page.evaluate(() => ['task', 'model', 'space'].map(id => document.getElementById(id).value)), ['push', 'tsm', 'direct']);
    assert.equal(await page.isChecked('#replan'), true);
    assert.equal(new URL(page.url()).hash.includes('target=-0.1,-0.12'), true);
    await page.locator('#figure-predicted .handle.target').focus();
    await page.keyboard.press('ArrowRight');
    assert.equal(new URL(page.url()).hash.includes('target=-0.095,-0.12'), true);
    for (let k = 0; k < 5; k++) await page.keyboard.press('Shift+ArrowUp');
    for (let k = 0; k < 5; k++) await page.keyboard.press('Shift+ArrowRight');
    assert.match(await text(page, '#outside'), /the target is 2\.1 cm from the shoulder/);
    await page.goto('about:blank');
    await page.goto(url + link);
    await ready(page);
    assert.equal(await page.isVisible('#outside'), false);
    await page.close();
  },

  async 'the tour has five scenes that show what they say'() {
    const page = await open('', { reducedMotion: 'reduce' }), seen = [];
    await ready(page);
    await page.click('#tour');
    const number = async id => Number((await text(page, id)).replace('−', '-').replace(' cm', ''));
    for (let k = 0; k < 5; k++) {
      await planned(page);
      await onFirstScreen(page, ['#guide', '#numbers', '#meaning', '#agreement', '#time', '#legend']);
      seen.push({
        title: await text(page, '#guide-title'), predicted: await number('#predicted-return'), executed: await number('#executed-return'),
        distance: await number('#distance'),
      });
      if (folder) await page.screenshot({ path: `${folder}/tour-${k + 1}.png` });
      if (k < 4) {
        await page.click('#guide-next');
        await afresh(page);
      }
    }
    measured.tour = seen;
    const gap = k => seen[k].predicted - seen[k].executed, arrived = k => seen[k].distance < 5;
    for (const [k, agrees] of [[0, Math.abs(gap(0)) < 1], [3, Math.abs(gap(3)) < 2]]) assert.ok(agrees && arrived(k), JSON.stringify(seen[k]));
    assert.ok(seen[4].distance < 6, JSON.stringify(seen[4])); // with reduced motion, the full search
    assert.ok(gap(2) > 4 && !arrived(2), JSON.stringify(seen[2]));
    await accessible(page, 'tour');
    await page.uncheck('#replan');
    await afresh(page);
    await planned(page);
    measured.tour_without_replanning_cm = await number('#distance');
    assert.ok(measured.tour_without_replanning_cm > seen[4].distance);
    await page.click('#guide-end');
    assert.equal(await page.isVisible('#guide'), false);
    assert.deepEqual(page.errors, []);
    await page.close();
  },

  async 'it reads well on a small dark screen'() {
    const page = await open('', { viewport: { width: 390, height: 844 }, colorScheme: 'dark', reducedMotion: 'reduce', hasTouch: true });
    await ready(page);
    await planned(page);
    const gap = await page.locator('#verdict').boundingBox().then(box => box.y) - await below(page, '#predicted');
    assert.ok(gap >= 0 && gap < 16, 'the verdict is not directly under the picture');
    assert.equal(await text(page, '#clock'), '2.00 s'); // no film, the end
    await page.selectOption('#model', 'onestep');
    assert.ok(await below(page, '#predicted') > 0, 'the picture of what was chosen is out of sight');
    await planned(page);
    assert.ok(await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth), 'it is wider than the screen');
    await accessible(page, '390 px, dark');
    if (folder) await page.screenshot({ path: `${folder}/390-dark.png`, fullPage: true });
    await page.close();
  },

  async 'what cannot work is said in one sentence'() {
    const bad = await open('#task=push&target=nowhere');
    await ready(bad);
    assert.match(await text(bad, '#notice'), /link cannot be restored: its target is not two numbers/);
    await bad.close();
    const spoiled = [
      ['**/manifest.json', route => route.fulfill({ json: { format: 0 } }), /format 0, this page reads 3; build it again/],
      ['**/manifest.json', route => route.fulfill({ body: '{"format": 3, ' }), /manifest.json is damaged; build the page again/],
      ['**/manifest.json', route => route.fulfill({ status: 404 }), /manifest.json did not come; reload the page/],
      ['**/ReacherPush-rtsm.f32', route => route.fulfill({ body: Buffer.alloc(8) }), /not the file that belongs to this page/],
      ['**/ReacherPush-rtsm.f32', async route => route.fulfill({ body: (await (await route.fetch()).body()).fill(0) }), /not the file that belongs to this page/],
      ['**/kernel*.wasm', route => route.fulfill({ body: Buffer.from([0, 97, 115, 109, 9]) }), /lacks WebAssembly SIMD/],
      ['**/src/worker.js', async route => {
        const answer = await route.fetch();
        return route.fulfill({ response: answer, body: `delete globalThis.WebAssembly;${await answer.text()}` });
      }, /lacks WebAssembly, or it is switched off; allow it/],
      ['**/vendor/mujoco.wasm', route => route.fulfill({ status: 404 }), /MuJoCo did not start/],
    ];
    for (const [files, answer, message] of spoiled) {
      const page = await open('', {}, one => one.route(files, answer));
      await page.waitForSelector('#notice:not([hidden])', slow);
      assert.match(await text(page, '#notice'), message);
      await page.close();
    }
  },
};

let failed = 0;
for (const [sentence, check] of Object.entries(steps).filter(([sentence]) => sentence.includes(only))) {
  try {
    await check();
    console.error(`ok  ${sentence}`);
  } catch (error) {
    failed += 1;
    console.error(`FAILED  ${sentence}: ${error.stack}`);
  }
}
await browser.close();
console.log(JSON.stringify(measured));
process.exit(failed ? 1 : 0);

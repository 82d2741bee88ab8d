// node test/look.mjs URL FOLDER: pictures of the page at two widths, light and dark, after one plan.
import { launch, planned, ready } from './browser.mjs';

const [url, folder] = process.argv.slice(2);
const browser = await launch();
for (const [width, height, colorScheme] of [[1440, 900, 'light'], [390, 844, 'light'], [1440, 900, 'dark'], [390, 844, 'dark']]) {
  const page = await browser.newPage({ viewport: { width, height }, colorScheme, reducedMotion: 'reduce' });
  page.on('console', message => console.log(message.type(), message.text()));
  page.on('pageerror', error => console.log('error', error.message));
  await page.goto(url);
  await ready(page);
  await planned(page);
  console.log(await page.textContent('#verdict'), await page.textContent('#numbers'));
  await page.screenshot({ path: `${folder}/${width}-${colorScheme}.png`, fullPage: true });
  await page.close();
}
await browser.close();

// A page in light and dark and at three widths.

import assert from "node:assert/strict";
import { keepPicture, mapSettled, openPage, seriousViolations, soon } from "./support.mjs";

const SIZES = [
  { width: 1440, height: 900 },
  { width: 768, height: 1024 },
  { width: 360, height: 740 },
];

/** Looks at a page in all sizes and schemes: keeps a picture, checks what a program can check. It is loaded once and then changes, as when a tablet is turned. */
export async function lookAround(browser, at, name, address, ready) {
  const { page, close } = await openPage(browser, at, { viewport: SIZES[0] });
  await page.goto(address);
  await ready(page);
  for (const colorScheme of ["light", "dark"]) {
    for (const viewport of SIZES) {
      const look = `${name}-${viewport.width}-${colorScheme}`;
      await page.emulateMedia({ colorScheme });
      await page.setViewportSize(viewport);
      for (const map of await page.locator(".map-panel").all()) await mapSettled(page, map);
      await soon("pictures are loaded", () => page.evaluate(() => [...document.images].every((image) => image.complete || image.loading === "lazy")));
      await keepPicture(page, look);
      assert.equal(await page.evaluate(() => document.documentElement.scrollWidth - innerWidth), 0, `${look}: nothing sticks out to the side`);
      assert.deepEqual(await seriousViolations(page), [], look);
    }
  }
  await close();
}

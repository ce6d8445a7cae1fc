// Visit the board from file:// at three widths in two color schemes, do a stranger's task, race; called by
// scripts/check-board.
import { existsSync, mkdirSync, readFileSync, readdirSync, statSync } from "node:fs";
import { createRequire } from "node:module";
import { availableParallelism, loadavg } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const WIDTHS = [1400, 800, 390];
const SCHEMES = ["light", "dark"];
const LARGEST = 1.5e6; // bytes
const SAME = 1e-9; // rad, m
const FIRST_PICTURE = 1000; // ms
const FRAME_RATE = 60; // 1/s
const ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"];
const AXE = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");

// Frames are counted only where the machine has time for them: its load before the browser starts.
const busy = loadavg()[0] > availableParallelism();

const [root, arms, hostile, ...options] = process.argv.slice(2);
const screenshots = options.includes("--screenshots") ? options[options.indexOf("--screenshots") + 1] : null;
if (screenshots) mkdirSync(screenshots, { recursive: true });
const page = pathToFileURL(join(root, "index.html")).href;
const faults = new Map();
const fault = (kind, text) => faults.set(kind, [...(faults.get(kind) ?? []), text]);
for (const kind of ["console errors", "axe violations", "wider than the page", "requests elsewhere", "stranger's task", "keys", "arm", "race", "size", "hostile names"]) faults.set(kind, []);

const sizeOf = (folder) => readdirSync(folder, { withFileTypes: true }).reduce((sum, entry) => sum + (entry.isDirectory() ? sizeOf(join(folder, entry.name)) : statSync(join(folder, entry.name)).size), 0);
const size = sizeOf(root);
console.log(`size: ${size} bytes`);
if (size > LARGEST) fault("size", `${size} bytes`);

const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ARGUMENTS, headless: true });

function watched(tab, view) {
  tab.on("console", (message) => ["error", "warning"].includes(message.type()) && fault("console errors", `${view()}: ${message.text()}`));
  tab.on("pageerror", (error) => fault("console errors", `${view()}: ${error.message}`));
  tab.on("request", (request) => !/^(file|data|blob):/.test(request.url()) && fault("requests elsewhere", `${view()}: ${request.url()}`));
}

// Go to a view and wait until it is drawn.
async function open(tab, base, hash) {
  const before = await tab.evaluate(() => globalThis.servotrack?.shown ?? 0).catch(() => 0);
  const same = tab.url().startsWith(base);
  if (same) await tab.evaluate((next) => { location.hash = next; }, hash);
  else await tab.goto(base + hash);
  await tab.waitForFunction((count) => globalThis.servotrack?.shown > count, same ? before : 0, { timeout: 20000 });
}

async function axe(tab, view) {
  if (!(await tab.evaluate(() => "axe" in globalThis))) await tab.evaluate(AXE);
  const found = await tab.evaluate(() => axe.run(document, { resultTypes: ["violations"], preload: false }));
  for (const violation of found.violations) fault("axe violations", `${view}: ${violation.id} (${violation.nodes.length}): ${violation.nodes.slice(0, 3).map((node) => node.target.join(" ")).join(" | ")}`);
}

// Addresses of all kinds of views, from the page's own tables.
const probe = await browser.newPage();
await probe.goto(page);
const views = await probe.evaluate(() => {
  const ns = globalThis.servotrack, board = ns.data.board(), list = [["all levels", "#/board"]];
  const worlds = board.suites.flatMap((suite) => suite.worlds);
  for (const world of worlds) list.push([world.name, ns.address("board", { world: world.name })]);
  const world = worlds.find((one) => one.replays) ?? worlds[0], task = world.tasks[Math.min(3, world.tasks.length - 1)].name;
  list.push(["one level", ns.address("board", { task })], ["compare", ns.address("compare", { task })], ["cost", ns.address("compute", {})], ["tuning", ns.address("compute", { task, cost: "tuning" })], ["proof", "#/proof"]);
  for (const one of worlds.filter((given) => given.replays)) {
    const watched = one.tasks[Math.min(3, one.tasks.length - 1)], [agent, other] = watched.rows.filter((row) => row.watch.length).map((row) => row.agent);
    list.push([`watch ${one.name}`, ns.address("watch", { task: watched.name, agent, episode: "worst" })]);
    if (other) list.push([`watch two in ${one.name}`, ns.address("watch", { task: watched.name, agent, episode: "worst", with: other })]);
  }
  if (ns.raceable()) list.push(["race", "#/race"]);
  return list;
});
await probe.close();

for (const scheme of SCHEMES) {
  for (const width of WIDTHS) {
    const context = await browser.newContext({ viewport: { width, height: width < 500 ? 844 : 900 }, colorScheme: scheme, reducedMotion: "reduce" });
    const tab = await context.newPage();
    let view = "";
    watched(tab, () => view);
    for (const [name, hash] of views) {
      view = `${name} at ${width} px, ${scheme}`;
      await open(tab, page, hash);
      await tab.waitForTimeout(120);
      const wide = await tab.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
      if (wide > 1) fault("wider than the page", `${view}: by ${wide} px`);
      if (screenshots) await tab.screenshot({ path: join(screenshots, `${name.replaceAll(/[^\w-]+/g, "_")}-${width}-${scheme}.png`), fullPage: true });
      await axe(tab, view);
    }
    await context.close();
  }
}
console.log(`views: ${views.length * WIDTHS.length * SCHEMES.length}`);

// A stranger's task: find PPO's worst episode at level 3 and watch it.
for (const width of WIDTHS) {
  const context = await browser.newContext({ viewport: { width, height: 844 } });
  const tab = await context.newPage();
  watched(tab, () => `stranger at ${width} px`);
  await tab.goto(page);
  let clicks = 0;
  const click = async (locator) => { await locator.click({ timeout: 5000 }); clicks += 1; };
  try {
    await click(tab.getByRole("navigation", { name: "Levels" }).getByRole("link", { name: /^3\b/ }));
    await click(tab.getByRole("link", { name: "Watch ppo's worst episode" }));
    await tab.getByRole("heading", { level: 1, name: /^ppo worst episode/ }).waitFor({ timeout: 5000 });
    const clock = () => tab.locator(".clock").textContent();
    const first = await clock();
    await tab.waitForTimeout(700);
    if ((await clock()) === first) fault("stranger's task", `${width} px: the episode does not play`);
    console.log(`stranger's task at ${width} px: ${clicks} clicks`);
    if (clicks > 3) fault("stranger's task", `${clicks} clicks`);
  } catch (error) {
    fault("stranger's task", `${width} px: ${error.message.split("\n")[0]}`);
  }
  await context.close();
}

// Every kind of replay is driven by keys alone, and says what it shows.
{
  const context = await browser.newContext({ viewport: { width: 1400, height: 900 }, reducedMotion: "reduce" });
  const tab = await context.newPage();
  watched(tab, () => "keys");
  for (const [name, hash] of views.filter(([given]) => given.startsWith("watch "))) {
    await open(tab, page, hash);
    const said = () => tab.evaluate(() => document.querySelector("input[type=range]").getAttribute("aria-valuetext"));
    const first = await said();
    await tab.keyboard.press("ArrowRight");
    const second = await said();
    await tab.keyboard.press(" ");
    await tab.waitForTimeout(600);
    const third = await said();
    if (!first || first === second || second === third) fault("keys", `${name}: ${first} | ${second} | ${third}`);
  }
  await context.close();
}

// The arm moves as the package's.
{
  const tab = await browser.newPage();
  await tab.goto(page);
  const worst = await tab.evaluate((cases) => globalThis.servotrack.arm.compare(cases), JSON.parse(readFileSync(arms, "utf8")));
  for (const one of worst) if (Math.max(one.joints, one.tool, one.error) > SAME) fault("arm", JSON.stringify(one));
  console.log(`arm: ${worst.length} episodes, largest difference ${Math.max(...worst.map((one) => Math.max(one.joints, one.tool, one.error)))}`);
  await tab.close();
}

// A race, driven by the mouse, then by keys.
if (views.some(([name]) => name === "race")) {
  const context = await browser.newContext({ viewport: { width: 1400, height: 900 } });
  const tab = await context.newPage();
  watched(tab, () => "race");
  const pictures = [];
  for (let k = 0; k < 3; k++) {
    await tab.goto("about:blank");
    await tab.goto(`${page}#/race`);
    await tab.waitForFunction(() => globalThis.servotrack?.raceStats?.picture, null, { timeout: 20000 });
    pictures.push(await tab.evaluate(() => globalThis.servotrack.raceStats.picture));
  }
  console.log(`race: first picture after ${pictures.map((time) => time.toFixed(0)).join(", ")} ms`);
  if (Math.min(...pictures) > FIRST_PICTURE) fault("race", `first picture after ${pictures} ms`);
  for (const mode of ["follow the pointer", "drive the joints"]) {
    await tab.getByRole("button", { name: mode }).click();
    await tab.getByRole("button", { name: "Start" }).click();
    const box = await tab.locator("canvas.floor").boundingBox();
    await tab.waitForFunction(() => globalThis.servotrack.raceStats.started > 0 && !document.querySelector(".count"), null, { timeout: 10000 });
    if (mode === "drive the joints") await tab.keyboard.down("ArrowUp");
    // Few moves and no polling: what drives the browser takes its time, too.
    for (let k = 0; k < 34; k++) {
      await tab.mouse.move(box.x + box.width * (0.6 + 0.12 * Math.sin(k / 2)), box.y + box.height * (0.45 + 0.1 * Math.cos(k / 2)));
      await tab.waitForTimeout(400);
      if (screenshots && k === 12) await tab.screenshot({ path: join(screenshots, `racing-${mode.replaceAll(" ", "_")}.png`) });
    }
    if (mode === "drive the joints") await tab.keyboard.up("ArrowUp");
    await tab.locator(".card").waitFor({ timeout: 10000 }).catch(() => {});
    const stats = await tab.evaluate(() => globalThis.servotrack.raceStats);
    const rate = (1000 * (stats.frames - 1)) / (stats.ended - stats.started);
    console.log(`race, ${mode}: ${rate.toFixed(1)} frames a second, slowest frame ${stats.slowest.toFixed(0)} ms, drawing ${(stats.drawing / stats.frames).toFixed(2)} ms a frame`);
    if (!(await tab.locator(".card").count())) fault("race", `${mode}: no result`);
    if (rate < FRAME_RATE - 1 && !busy) fault("race", `${mode}: ${rate.toFixed(1)} frames a second`);
    if (rate < FRAME_RATE - 1 && busy) console.log(`  not judged: the machine's load is ${loadavg()[0].toFixed(1)} on ${availableParallelism()} cores`);
    if (screenshots) await tab.screenshot({ path: join(screenshots, `raced-${mode.replaceAll(" ", "_")}.png`) });
    await axe(tab, "race, result");
  }
  await context.close();
}

// Names that would be markup or scripts elsewhere stay text.
if (existsSync(hostile)) {
  const tab = await browser.newPage();
  watched(tab, () => "hostile");
  tab.on("dialog", (dialog) => { fault("hostile names", dialog.message()); dialog.dismiss(); });
  const base = pathToFileURL(join(hostile, "index.html")).href;
  await tab.goto(base);
  const addresses = await tab.evaluate(() => {
    const ns = globalThis.servotrack;
    return ns.data.board().suites.flatMap((suite) => suite.worlds.flatMap((world) => world.tasks.flatMap((task) => task.rows.flatMap((row) => ["board", "compare", "compute", "watch", "proof"].map((view) => ns.address(view, { suite: suite.name, world: world.name, task: task.name, agent: row.agent, a: row.agent }))))));
  });
  for (const hash of addresses) {
    await open(tab, base, hash);
    const state = await tab.evaluate(() => ({ hacked: globalThis.hacked, foreign: document.querySelectorAll("main script, main img, main iframe").length, alert: document.querySelector("[role=alert]")?.textContent }));
    if (state.hacked || state.foreign || state.alert) fault("hostile names", `${hash}: ${JSON.stringify(state)}`);
  }
  console.log(`hostile names: ${addresses.length} views`);
  await tab.close();
}

await browser.close();
let failed = false;
for (const [kind, found] of faults) {
  console.log(`${kind}: ${found.length}`);
  for (const line of found.slice(0, 30)) console.log(`  ${line}`);
  failed ||= found.length > 0;
}
process.exit(failed ? 1 : 0);

// Visit every page of a static site at three widths in two color schemes; called by scripts/check-site.
import { createServer } from "node:http";
import { createReadStream, existsSync, mkdirSync, mkdtempSync, readFileSync, readdirSync, rmSync, statSync } from "node:fs";
import { tmpdir } from "node:os";
import { extname, join, normalize, relative } from "node:path";
import { createRequire } from "node:module";
import { chromium } from "playwright-core";

const WIDTHS = [1400, 800, 390];
const SCHEMES = ["light", "dark"];
const WORKERS = 2;
const TYPES = {
  ".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css", ".json": "application/json",
  ".svg": "image/svg+xml", ".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp", ".xml": "text/xml",
};
const ARGUMENTS = [
  "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
  "--disable-component-update", "--disable-sync", "--hide-scrollbars",
];
const AXE = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");

const [root, ...options] = process.argv.slice(2);
const option = (name) => (options.includes(name) ? options[options.indexOf(name) + 1] : undefined);
const only = option("--only");
const screenshots = option("--screenshots");
if (screenshots) mkdirSync(screenshots, { recursive: true });

function htmlFiles(folder) {
  return readdirSync(folder, { withFileTypes: true }).flatMap((entry) => {
    const path = join(folder, entry.name);
    if (entry.isDirectory()) return htmlFiles(path);
    return entry.name.endsWith(".html") ? [relative(root, path)] : [];
  });
}

const server = createServer((request, response) => {
  const path = join(root, normalize(decodeURIComponent(new URL(request.url, "http://x").pathname)));
  const file = existsSync(path) && statSync(path).isDirectory() ? join(path, "index.html") : path;
  if (!existsSync(file)) return response.writeHead(404).end();
  response.writeHead(200, { "content-type": TYPES[extname(file)] ?? "application/octet-stream" });
  createReadStream(file).pipe(response);
});
await new Promise((ready) => server.listen(0, "127.0.0.1", ready));
const origin = `http://127.0.0.1:${server.address().port}`;

const pages = htmlFiles(root).filter((page) => !only || page === only).sort();
const faults = { "console errors": new Set(), "axe violations": new Set(), "broken links": new Set(), "wider than the page": new Set(), "requests to another host": new Set() };
const anchors = new Map();
const links = new Map();

function knownAnchors(page) {
  if (!anchors.has(page)) {
    const text = existsSync(join(root, page)) ? readFileSync(join(root, page), "utf8") : null;
    anchors.set(page, text === null ? null : new Set([...text.matchAll(/\s(?:id|name)="?([^"\s>]+)/g)].map((found) => found[1].replaceAll("&amp;", "&"))));
  }
  return anchors.get(page);
}

async function visit(page, width, scheme, context) {
  const view = `${page} at ${width} px, ${scheme}`;
  const tab = await context.newPage();
  tab.on("console", (message) => ["error", "warning"].includes(message.type()) && faults["console errors"].add(`${view}: ${message.text()}`));
  tab.on("pageerror", (error) => faults["console errors"].add(`${view}: ${error.message}`));
  tab.on("requestfailed", (request) => faults["console errors"].add(`${view}: ${request.url()} failed`));
  tab.on("request", (request) => !request.url().startsWith(origin) && !/^(data|blob):/.test(request.url()) && faults["requests to another host"].add(`${view}: ${request.url()}`));
  await tab.goto(`${origin}/${page}`, { waitUntil: "load" });
  await tab.waitForTimeout(150);
  const active = await tab.evaluate(() => document.body.dataset.mdColorScheme);
  if (active && (active === "slate") !== (scheme === "dark")) faults["console errors"].add(`${view}: color scheme is ${active}`);
  const wide = await tab.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
  if (wide > 1) faults["wider than the page"].add(`${view}: by ${wide} px`);
  if (width === WIDTHS[0] && scheme === SCHEMES[0]) links.set(page, await tab.evaluate(() => [...document.querySelectorAll("a[href]")].map((a) => a.href)));
  if (screenshots) await tab.screenshot({ path: join(screenshots, `${page.replaceAll("/", "_")}-${width}-${scheme}.png`), fullPage: options.includes("--full") });
  await tab.evaluate(AXE);
  const found = await tab.evaluate(() => axe.run(document, { resultTypes: ["violations"] }));
  for (const violation of found.violations) faults["axe violations"].add(`${view}: ${violation.id} (${violation.nodes.length}): ${violation.nodes.slice(0, 3).map((node) => node.target.join(" ")).join(" | ")}`);
  await tab.close();
}

const profile = mkdtempSync(join(tmpdir(), "check-site-"));
const browser = await chromium.launchPersistentContext(profile, { executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ARGUMENTS, headless: true });
const jobs = SCHEMES.flatMap((scheme) => WIDTHS.map((width) => ({ scheme, width })));
for (const { scheme, width } of jobs) {
  const context = await browser.browser()?.newContext({ viewport: { width, height: 900 }, colorScheme: scheme, reducedMotion: "reduce" });
  const queue = [...pages];
  await Promise.all(Array.from({ length: WORKERS }, async () => {
    for (let page = queue.shift(); page; page = queue.shift()) await visit(page, width, scheme, context);
  }));
  await context.close();
}

// One search, so that the index and its worker are seen to load from here.
const context = await browser.browser()?.newContext({ viewport: { width: 1400, height: 900 } });
const tab = await context.newPage();
tab.on("request", (request) => !request.url().startsWith(origin) && !/^(data|blob):/.test(request.url()) && faults["requests to another host"].add(`search: ${request.url()}`));
await tab.goto(`${origin}/index.html`);
await tab.click("label.md-search__icon[for='__search'], .md-search__input");
await tab.waitForTimeout(1000);
await tab.locator(".md-search__input").pressSequentially("Kalman", { delay: 50 });
await tab.waitForSelector(".md-search-result__item", { timeout: 30000 }).catch(() => faults["console errors"].add("search: no result for Kalman"));
if (screenshots) await tab.screenshot({ path: join(screenshots, "search.png") });
await browser.close();
server.close();
rmSync(profile, { recursive: true, force: true });

let internal = 0;
for (const [page, targets] of links) {
  for (const target of new Set(targets)) {
    if (!target.startsWith(origin)) continue;
    internal += 1;
    const url = new URL(target);
    const path = decodeURIComponent(url.pathname).replace(/^\//, "").replace(/(^|\/)$/, "$1index.html");
    if (!existsSync(join(root, path))) faults["broken links"].add(`${page}: ${target.slice(origin.length)}`);
    else if (url.hash && path.endsWith(".html") && !knownAnchors(path).has(decodeURIComponent(url.hash.slice(1)))) faults["broken links"].add(`${page}: ${target.slice(origin.length)} (no such anchor)`);
  }
}

let failed = false;
console.log(`${pages.length} pages, ${pages.length * jobs.length} views, ${internal} internal links`);
for (const [kind, found] of Object.entries(faults)) {
  console.log(`${kind}: ${found.size}`);
  for (const line of [...found].slice(0, 40)) console.log(`  ${line}`);
  failed ||= found.size > 0;
}
process.exit(failed ? 1 : 0);

// Addresses, navigation, and the frame around all views.
(async function () {
  "use strict";
  const ns = window.servotrack;
  const { h } = ns;
  const VIEWS = { board: "Board", watch: "Watch", compare: "Compare", compute: "Cost", race: "Race the filter", proof: "Proof" };
  const board = await ns.data.ready();
  const main = document.getElementById("main");
  let leave = null, turn = 0, first = true;

  ns.raceable = () => Boolean(board?.race);
  const replayable = () => board.suites.some((suite) => suite.worlds.some((world) => world.replays));

  // View, suite, world and task that the address names; what it does not name is the first one.
  function here() {
    const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
    const parameters = new URLSearchParams(query || "");
    const view = path in VIEWS && (path !== "race" || ns.raceable()) ? path : "board";
    const name = parameters.get("task");
    const suite = board.suites.find((one) => one.name === parameters.get("suite")) ?? board.suites.find((one) => one.worlds.some((world) => world.tasks.some((task) => task.name === name))) ?? board.suites[0];
    const world = suite.worlds.find((one) => one.tasks.some((task) => task.name === name)) ?? suite.worlds.find((one) => one.name === parameters.get("world")) ?? suite.worlds[0];
    const task = world.tasks.find((one) => one.name === name) ?? (world.tasks.length === 1 ? world.tasks[0] : null);
    const names = { suite: board.suites.length > 1 ? suite.name : null, world: suite.worlds.length > 1 ? world.name : null, task: task?.name };
    return { view, suite, world, task, names, parameters };
  }

  async function show(moved) {
    const where = here(), own = ++turn;
    let made;
    try {
      made = await ns.views[where.view](where);
    } catch (error) {
      made = { title: "Missing data", node: h("p", { role: "alert" }, `This view cannot be drawn: ${error.message}.`) };
    }
    if (own !== turn) { made.leave?.(); return; }
    leave?.();
    leave = made.leave ?? null;
    main.replaceChildren(...[made.node].flat().filter(Boolean));
    main.dataset.view = where.view;
    for (const strip of document.querySelectorAll(".tabs")) {
      const current = strip.querySelector("[aria-current]");
      if (current) strip.scrollLeft = current.offsetLeft - strip.offsetLeft - (strip.clientWidth - current.offsetWidth) / 2;
    }
    document.title = `${made.title} · servotrack board`;
    navigation(where);
    if (moved && !first) { main.focus({ preventScroll: true }); if (where.view !== show.view) scrollTo(0, 0); }
    show.view = where.view;
    first = false;
    ns.shown = (ns.shown || 0) + 1;
  }

  function navigation({ view, names, parameters }) {
    const links = Object.entries(VIEWS).filter(([name]) => (name !== "race" || ns.raceable()) && (name !== "watch" || replayable())).map(([name, text]) => h("a", { href: ns.address(name, name === "race" || name === "proof" ? {} : { ...names, ...(name === "watch" ? { agent: parameters.get("agent") } : {}) }), "aria-current": name === view ? "page" : null }, text));
    const bar = document.getElementById("views");
    bar.replaceChildren(...links);
    const current = bar.querySelector("[aria-current]");
    if (current) bar.scrollLeft = current.offsetLeft - bar.offsetLeft - (bar.clientWidth - current.offsetWidth) / 2;
  }

  const button = document.getElementById("scheme");
  const name = () => { const dark = ns.scheme.get() === "dark"; button.textContent = dark ? "☀" : "☾"; button.setAttribute("aria-label", dark ? "Light colors" : "Dark colors"); };
  button.addEventListener("click", () => { ns.scheme.set(ns.scheme.get() === "dark" ? "light" : "dark"); });
  window.addEventListener("schemechange", () => { name(); if (["watch", "race"].includes(here().view)) show(false); });
  name();

  if (!board) {
    main.replaceChildren(h("p", { role: "alert" }, "data/board.js is missing beside this page."));
    return;
  }
  ns.refresh = () => show(false);
  // Figures are drawn for the width of the window.
  let width = innerWidth, later = 0;
  window.addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(later);
    later = setTimeout(() => { if (["board", "compare", "compute"].includes(here().view)) ns.refresh(); }, 200);
  });
  window.addEventListener("hashchange", () => { if (!location.hash || location.hash.startsWith("#/")) show(true); });
  document.getElementById("origin").replaceChildren(h("p", {}, "Written by ", h("code", {}, board.command), ` from results ${board.stamp}. All numbers come from the rows of single episodes; nothing on this page is loaded from elsewhere.`));
  show(false);
})();

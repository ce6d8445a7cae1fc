// The table: all levels of a world or one of them, sorted, filtered, with forest plots and links to replays.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h, plots } = ns;
  const FOREST = 156, ROW = 26;
  const HEAT = [0.5, 1.0]; // scores without color, with the fullest
  const COMPUTE = [["", "any compute"], ["5e-5", "≤ 50 µs a step"], ["2e-4", "≤ 200 µs a step"], ["5e-4", "≤ 500 µs a step"]];
  const TUNING = [["", "any tuning"], ["0", "no tuning"], ["1e6", "≤ 1 M steps"]];
  const kept = { hidden: new Set(), compute: "", tuning: "", search: "", sort: {} };

  const select = (label, options, value, onchange) => {
    const node = h("select", { "aria-label": label, onchange: () => onchange(node.value) }, options.map(([key, text]) => h("option", { value: key }, text)));
    node.value = value;
    return node;
  };

  function passes(row) {
    if (kept.hidden.has(ns.kind(row.information))) return false;
    if (kept.compute && !(row.stepSeconds <= Number(kept.compute) && row.stepSeconds !== null)) return false;
    if (kept.tuning && !(row.tuningSteps !== null && row.tuningSteps <= Number(kept.tuning))) return false;
    return !kept.search || row.agent.toLowerCase().includes(kept.search.toLowerCase());
  }

  const interval = (values, digits, factor = 1) => (values ? `${ns.fixed(values[0] * factor, digits)}` : "");
  const wide = (values, digits, factor = 1) => (values && values[1] !== null ? ` [${ns.fixed(values[1] * factor, digits)}, ${ns.fixed(values[2] * factor, digits)}]` : "");
  const spread = (values, digits, factor) => values && [interval(values, digits, factor), h("span", { class: "interval" }, wide(values, digits, factor))];

  function agentCell(row, extra) {
    return h("th", { scope: "row", class: "agent" },
      ns.dot(row.information), h("span", { class: "name" }, row.agent),
      h("span", { class: "class" }, ns.kind(row.information), extra));
  }

  // Columns: key, title, value to sort by, cell, class of the cell, true if high values come first.
  function taskColumns(where) {
    const { task, world } = where;
    const headline = task.measures.find((measure) => measure.column === task.headline);
    const others = task.measures.filter((measure) => measure !== headline);
    const reference = task.rows.some((row) => row.difference);
    const columns = [];
    if (task.scored) columns.push({ key: "score", title: "score", sort: (row) => row.score?.[0], cell: (row) => spread(row.score, 2), high: true });
    const main = task.scored ? (row) => row.score : (row) => row.measures[task.headline]?.map((value) => (value === null ? null : value * headline.factor));
    columns.push({ key: "forest", forest: main, high: task.scored || headline.highIsGood, digits: task.scored ? 2 : headline.digits, title: task.scored ? "score, 95 % interval" : `${headline.heading} ${headline.unit}, 95 % interval` });
    if (task.rows.some((row) => row.watch.length)) columns.push({ key: "watch", title: "watch", class: "watch", cell: (row) => row.watch.map((which, k) => [k ? " " : "", h("a", { href: ns.address("watch", { ...where.names, agent: row.agent, episode: which }), "aria-label": `Watch ${row.agent}'s ${which} episode` }, which)]) });
    if (task.rows.some((row) => row.success)) columns.push({ key: "success", title: "success %", sort: (row) => row.success?.[0], cell: (row) => interval(row.success, 0, 100), high: true });
    for (const measure of [headline, ...others]) columns.push({ key: measure.column, title: `${measure.heading} ${measure.unit}`, sort: (row) => row.measures[measure.column]?.[0], cell: (row) => interval(row.measures[measure.column], measure.digits, measure.factor), high: measure.highIsGood });
    if (task.scored) columns.push({ key: "worst", title: "worst tenth", hint: "mean score of the worst tenth of the episodes", sort: (row) => row.worst, cell: (row) => ns.fixed(row.worst, 2), high: true });
    if (task.rows.some((row) => row.sealed)) columns.push({ key: "sealed", title: "sealed, fresh", hint: "mean scores on the form of sealed seeds that the agent's files choose, and on seeds that the verifier drew", sort: (row) => row.sealed?.[0], high: true,
      cell: (row) => row.sealed && [interval(row.sealed, 2), row.fresh !== null && h("span", { class: "soft" }, `, ${ns.fixed(row.fresh, 2)}`)] });
    else if (task.rows.some((row) => row.overBound !== null)) columns.push({ key: "bound", title: "× bound", hint: "mean error over the least that is possible", sort: (row) => row.overBound, cell: (row) => ns.fixed(row.overBound, 2) });
    if (reference) columns.push({ key: "difference", title: `− ${task.reference} ${headline.unit}`, hint: "mean difference by seed; * below p = 0.05 after Holm's correction", sort: (row) => row.difference?.[0], high: headline.highIsGood,
      cell: (row) => row.difference && `${row.difference[0] > 0 ? "+" : ""}${ns.fixed(row.difference[0] * headline.factor, headline.digits)}${row.p !== null && row.p < 0.05 ? " *" : ""}` });
    columns.push(...costColumns());
    // On a narrow screen the links come before the wide figure.
    const links = columns.find((column) => column.key === "watch");
    if (links && innerWidth <= 640) columns.splice(1, 0, ...columns.splice(columns.indexOf(links), 1));
    return columns;
  }

  function costColumns() {
    return [
      { key: "time", title: "µs/step", hint: "median compute time of a step", sort: (row) => row.stepSeconds, cell: (row) => ns.micro(row.stepSeconds) },
      { key: "tuning", title: "tuning steps", hint: "environment steps of tuning or training", sort: (row) => row.tuningSteps, cell: (row) => ns.count(row.tuningSteps) },
    ];
  }

  function shade(value) {
    const share = Math.min(Math.max((value - HEAT[0]) / (HEAT[1] - HEAT[0]), 0), 1);
    return `heat heat-${Math.round(share * 10)}`;
  }

  // Rows and columns of the overview over all tasks of a world.
  function overview({ world }) {
    const rows = new Map();
    for (const task of world.tasks) for (const row of task.rows) {
      const seen = rows.get(row.agent) ?? { ...row, byTask: new Map(), stale: false, score: null, worst: null };
      seen.byTask.set(task.name, row);
      seen.stale ||= row.stale;
      rows.set(row.agent, seen);
    }
    for (const total of world.overall) Object.assign(rows.get(total.agent), { score: total.score, worst: total.worst, success: total.success });
    const scored = world.overall.length > 0;
    const columns = [];
    if (scored) {
      columns.push({ key: "score", title: "all levels", hint: "interquartile mean over all episodes", sort: (row) => row.score?.[0], cell: (row) => interval(row.score, 2), high: true });
      columns.push({ key: "forest", forest: (row) => row.score, high: true, digits: 2, title: "score, 95 % interval" });
    }
    for (const task of world.tasks) {
      const measure = task.measures.find((given) => given.column === task.headline);
      const value = task.scored ? (row) => row.byTask.get(task.name)?.score?.[0] : (row) => row.byTask.get(task.name)?.measures[task.headline]?.[0];
      columns.push({ key: task.name, title: task.label, class: "level", sort: value, high: task.scored || measure.highIsGood,
        cell: (row) => (value(row) === undefined || value(row) === null ? "" : task.scored ? ns.fixed(value(row), 2) : ns.measured(value(row), measure)),
        shade: task.scored ? (row) => (value(row) === undefined || value(row) === null ? "" : shade(value(row))) : null });
    }
    if (scored) columns.push({ key: "worst", title: "worst tenth", hint: "mean over levels of the mean score of the worst tenth of the episodes", sort: (row) => row.worst, cell: (row) => ns.fixed(row.worst, 2), high: true });
    columns.push(...costColumns());
    return { rows: [...rows.values()], columns };
  }

  function table(where, id) {
    const { rows, columns } = where.task ? { rows: where.task.rows, columns: taskColumns(where) } : overview(where);
    const all = [{ key: "agent", title: "agent", sort: (row) => row.agent }, { key: "proof", title: "proof", sort: (row) => row.proof }, ...columns];
    const chosen = kept.sort[id] ?? { key: (all.find((column) => column.key === "score") ?? all.find((column) => column.sort && column.key !== "agent" && column.key !== "proof")).key, down: null };
    const column = all.find((given) => given.key === chosen.key) ?? all[0];
    const down = chosen.down ?? Boolean(column.high);
    const shown = rows.filter(passes);
    const keyOf = (row) => { const value = column.sort(row); return value === undefined ? null : value; };
    shown.sort((a, b) => {
      const [x, y] = [keyOf(a), keyOf(b)];
      if (x === null || y === null) return (x === null) - (y === null);
      const order = typeof x === "string" ? x.localeCompare(y) : x - y;
      return down ? -order : order;
    });
    const forest = columns.find((given) => given.forest);
    const range = forest && plots.forestRange(shown.map(forest.forest), forest.high);
    const marks = forest && plots.ticks(range[0], range[1], 4);
    const digits = forest && marks.length > 1 ? Math.max(forest.digits - 1, Math.ceil(-Math.log10(marks[1] - marks[0]) - 1e-9), 0) : 2;

    const head = all.map((given) => {
      if (given.forest) return h("th", { scope: "col", class: "forest-cell" }, h("span", { class: "visually-hidden" }, given.title), plots.forestAxis(range, marks, FOREST, digits));
      if (!given.sort) return h("th", { scope: "col", class: given.class }, given.title);
      const active = given === column;
      const press = () => {
        kept.sort[id] = { key: given.key, down: active ? !down : Boolean(given.high) };
        ns.refresh();
        document.querySelector(`[data-sort="${CSS.escape(given.key)}"]`)?.focus();
      };
      return h("th", { scope: "col", class: given.class ?? (given.key === "agent" ? "agent" : given.key === "proof" ? "proof" : null), "aria-sort": active ? (down ? "descending" : "ascending") : null },
        h("button", { type: "button", class: "sort", "data-sort": given.key, title: given.hint, onclick: press }, given.title, h("span", { class: "arrow", "aria-hidden": "true" }, active ? (down ? "▾" : "▴") : "")));
    });
    const body = shown.map((row) => h("tr", { class: row.privileged ? "privileged" : null },
      agentCell(row, row.privileged ? " †" : ""),
      h("td", { class: "proof" }, ns.badge(row)),
      columns.map((given) => {
        if (given.forest) return h("td", { class: "forest-cell" }, plots.forestRow(given.forest(row), range, ns.kind(row.information), marks, FOREST, ROW));
        return h("td", { class: [given.class, given.shade?.(row)].filter(Boolean).join(" ") || null }, given.cell(row));
      })));
    const caption = where.task ? where.task.name : `${where.world.name}, all levels`;
    return h("div", { class: "scroll", role: "region", "aria-label": `Table: ${caption}`, tabindex: 0 },
      h("table", { class: "board" }, h("caption", { class: "visually-hidden" }, caption), h("thead", {}, h("tr", {}, head)),
        h("tbody", {}, body.length ? body : h("tr", {}, h("td", { class: "empty", colspan: all.length }, "No agent passes these filters.")))));
  }

  function filters(where) {
    const rows = where.task ? where.task.rows : where.world.tasks.flatMap((task) => task.rows);
    const present = Object.keys(ns.CLASSES).filter((name) => rows.some((row) => ns.kind(row.information) === name));
    const chips = present.map((name) => h("button", { type: "button", class: "chip", id: `class-${name}`, "aria-pressed": String(!kept.hidden.has(name)), title: ns.CLASSES[name],
      onclick: () => { if (!kept.hidden.delete(name)) kept.hidden.add(name); ns.refresh(); document.getElementById(`class-${name}`)?.focus(); } }, ns.dot(name), name));
    const search = h("input", { type: "search", placeholder: "agent", "aria-label": "Search agents", value: kept.search, id: "search",
      oninput: () => { kept.search = search.value; ns.refresh(); const again = document.getElementById("search"); again?.focus(); again?.setSelectionRange(again.value.length, again.value.length); } });
    const renew = (name, id) => (value) => { kept[name] = value; ns.refresh(); document.querySelector(`[aria-label="${id}"]`)?.focus(); };
    return h("div", { class: "filters", role: "group", "aria-label": "Filters" }, h("div", { class: "chips" }, chips),
      select("Compute", COMPUTE, kept.compute, renew("compute", "Compute")), select("Tuning", TUNING, kept.tuning, renew("tuning", "Tuning")), search);
  }

  // Tabs of worlds and levels; every view has them.
  function tabs(where, view, parameters = {}) {
    const { suite, world, task } = where;
    const link = (label, names, current) => h("a", { href: ns.address(view, { ...names, ...parameters }), "aria-current": current ? "true" : null }, label);
    const suites = ns.data.board().suites;
    const base = suites.length > 1 || suite.name ? { suite: suite.name } : {};
    return h("div", { class: "where" },
      suites.length > 1 && h("nav", { class: "tabs", "aria-label": "Suites" }, suites.map((given) => link(given.name || "results", { suite: given.name }, given === suite))),
      suite.worlds.length > 1 && h("nav", { class: "tabs", "aria-label": "Worlds" }, suite.worlds.map((given) => link(given.name, { ...base, world: given.name }, given === world))),
      h("nav", { class: "tabs levels", "aria-label": "Levels" },
        world.tasks.length > 1 && view !== "watch" && view !== "compare" && link("all levels", { ...base, world: world.name }, !task),
        world.tasks.map((given) => link(given.label, { ...base, world: world.name, task: given.name }, given === task))));
  }

  function note(where) {
    const { world, task } = where;
    const scored = task ? task.scored : world.overall.length > 0;
    return h("p", { class: "note" },
      scored && world.scale && `Score: 0 is ${world.scale[0]}, 1 is ${world.scale[1]}; the scale is logarithmic in ${world.scale[2]}. `,
      task && task.rows.some((row) => row.sealed) && "Ranked on public seeds; sealed ones are a form that the agent's files choose, fresh ones were drawn by the verifier. ",
      "Intervals: 95 %. † sees the truth. ",
      task && task.rows.some((row) => row.difference) && `Differences are paired by seed against ${task.reference}; * below p = 0.05 after Holm's correction. `,
      h("a", { href: ns.address("proof") }, "What the badges prove"), ".",
      task && task.notes.length > 0 && [h("br"), task.notes.join(" ")]);
  }

  function lede(where) {
    const board = ns.data.board();
    const agents = Object.keys(board.agents).length;
    const episodes = board.suites.flatMap((suite) => suite.worlds.flatMap((world) => world.tasks.flatMap((task) => task.rows))).reduce((sum, row) => sum + row.episodes, 0);
    return h("div", { class: "lede" },
      h("h1", {}, where.task ? `${where.world.name}, level ${where.task.label}` : where.world.name),
      h("p", {}, `${where.world.summary[0].toUpperCase()}${where.world.summary.slice(1)}. `, h("span", { class: "soft" }, `${agents} agents, ${episodes.toLocaleString("en").replaceAll(",", " ")} episodes on the board`), ". ",
        ns.raceable() && h("a", { class: "call", href: ns.address("race") }, "Race the filter")));
  }

  ns.views = ns.views || {};
  ns.views.board = (where) => {
    const id = where.task ? where.task.name : where.world.name;
    return { node: [lede(where), tabs(where, "board"), filters(where), table(where, id), note(where)], title: where.task ? where.task.name : where.world.name };
  };
  ns.parts = { tabs, select };
})();

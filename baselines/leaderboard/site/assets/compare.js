// Two agents on the same seeds: a paired scatter plot, whose points lead to the episodes.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h, s, plots } = ns;
  function chart(where, content, a, b, pairs, measure) {
    const { task } = where;
    const width = Math.max(330, Math.min(620, innerWidth - 32)), height = 0.92 * width;
    const box = { left: 64, right: width - 14, top: 28, bottom: height - 48 };
    const positive = pairs.every((pair) => pair.x > 0 && pair.y > 0);
    const all = pairs.flatMap((pair) => [pair.x, pair.y]).map((value) => value * measure.factor);
    const low = Math.min(...all), high = Math.max(...all);
    const log = positive && high / low > 5;
    const range = log ? [low / 1.15, high * 1.15] : [low - 0.05 * (high - low || 1), high + 0.05 * (high - low || 1)];
    const make = log ? plots.logarithmic : plots.linear;
    const x = make(...range, box.left, box.right), y = make(...range, box.bottom, box.top);
    const ticks = log ? plots.logTicks(...range) : plots.ticks(...range, 6);
    const text = (value) => String(Number(value.toPrecision(3)));
    const svg = s("svg", { class: "chart", viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": `Scatter plot of ${a} and ${b} over seeds` });
    plots.axes(svg, { box, x, y, xTicks: ticks, yTicks: ticks, xTitle: `${a}, ${measure.heading} ${measure.unit}`, yTitle: `${b}, ${measure.heading} ${measure.unit}`, xText: text, yText: text });
    svg.append(s("line", { class: "diagonal", x1: x(range[0]), y1: y(range[0]), x2: x(range[1]), y2: y(range[1]) }));
    const corner = measure.highIsGood ? [b, a] : [a, b];
    svg.append(s("text", { class: "hint", x: box.left + 10, y: box.top + 18 }, `${corner[0]} better`), s("text", { class: "hint", x: box.right - 10, y: box.bottom - 10, "text-anchor": "end" }, `${corner[1]} better`));
    const hint = h("p", { class: "hover", "aria-hidden": "true" }, pairs.some((pair) => pair.watch.length) ? `Filled points can be watched.${pairs.every((pair) => pair.watch.length) ? "" : " A site made with --every-seed shows all."}` : "");
    for (const pair of [...pairs].sort((p, q) => p.watch.length - q.watch.length)) {
      const label = `seed ${pair.seed}: ${a} ${ns.withUnit(pair.x, measure)}, ${b} ${ns.withUnit(pair.y, measure)}`;
      const point = s("circle", { class: `point${pair.watch.length ? " live" : ""}`, cx: x(pair.x * measure.factor), cy: y(pair.y * measure.factor), r: pair.watch.length ? 5.5 : 3.5 });
      const show = () => { hint.textContent = `${label}${pair.watch.length === 2 ? ": watch both" : pair.watch.length ? `: watch ${pair.watch[0]}` : ""}`; };
      if (pair.watch.length) {
        const [first, second] = pair.watch;
        svg.append(s("a", { href: ns.address("watch", { ...where.names, task: task.name, agent: first, seed: pair.seed, with: second }), "aria-label": `${label}. Watch ${pair.watch.join(" and ")}`, onmouseenter: show, onfocus: show }, point));
      } else {
        point.addEventListener("mouseenter", show);
        svg.append(point);
      }
    }
    return [svg, hint];
  }

  function verdict(a, b, pairs, measure) {
    const better = (first, second) => (measure.highIsGood ? first > second : first < second);
    const wins = pairs.filter((pair) => better(pair.x, pair.y)).length, losses = pairs.filter((pair) => better(pair.y, pair.x)).length;
    const differences = pairs.map((pair) => pair.x - pair.y);
    const mean = differences.reduce((sum, value) => sum + value, 0) / differences.length;
    const deviation = Math.sqrt(differences.reduce((sum, value) => sum + (value - mean) ** 2, 0) / Math.max(differences.length - 1, 1));
    const error = (1.96 * deviation) / Math.sqrt(differences.length);
    const middle = [...differences].sort((p, q) => p - q)[Math.floor(differences.length / 2)];
    const signed = (value) => `${value > 0 ? "+" : ""}${ns.measured(value, measure)}`;
    return h("dl", { class: "facts" },
      h("dt", {}, `${a} better`), h("dd", {}, `${wins} of ${pairs.length} seeds`),
      h("dt", {}, `${b} better`), h("dd", {}, `${losses} of ${pairs.length} seeds`),
      h("dt", {}, `mean of ${a} − ${b}`), h("dd", {}, `${signed(mean)} ${measure.unit}`, h("span", { class: "soft" }, ` ± ${ns.measured(error, measure)} (1.96 standard errors)`)),
      h("dt", {}, "median difference"), h("dd", {}, `${signed(middle)} ${measure.unit}`));
  }

  ns.views.compare = async (where) => {
    const task = where.task ?? where.world.tasks[Math.min(3, where.world.tasks.length - 1)];
    where = { ...where, task, names: { ...where.names, task: task.name } };
    const content = await ns.data.unpacked(task.chunk);
    const names = task.rows.map((row) => row.agent);
    const given = where.parameters;
    const pick = (name, fallback) => (names.includes(name) ? name : fallback);
    const a = pick(given.get("a"), pick("ppo", names[1] ?? names[0])), b = pick(given.get("b"), pick("lifted-kf", names[0]));
    const measure = task.measures.find((one) => one.column === task.headline);
    const watchable = new Set(content.replays.map((replay) => `${replay.seed} ${replay.agent}`));
    const pairs = content.seeds
      .map((seed, k) => ({ seed, x: content.values[a][k], y: content.values[b][k], watch: [a, b].filter((name, n, both) => both.indexOf(name) === n && watchable.has(`${seed} ${name}`)) }))
      .filter((pair) => pair.x !== null && pair.y !== null);
    const choose = (which) => (name) => { location.hash = ns.address("compare", { ...where.names, a, b, [which]: name }); };
    const options = names.map((name) => [name, name]);
    const list = h("details", { class: "seeds" }, h("summary", {}, "All seeds as a table"),
      h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "All seeds" }, h("table", { class: "board slim" }, h("thead", {}, h("tr", {}, ["seed", a, b, "watch"].map((title) => h("th", { scope: "col" }, title)))),
        h("tbody", {}, pairs.map((pair) => h("tr", {}, h("th", { scope: "row" }, pair.seed), h("td", {}, ns.withUnit(pair.x, measure)), h("td", {}, ns.withUnit(pair.y, measure)),
          h("td", {}, pair.watch.length > 0 && h("a", { href: ns.address("watch", { ...where.names, agent: pair.watch[0], seed: pair.seed, with: pair.watch[1] }), "aria-label": `Watch seed ${pair.seed}` }, pair.watch.length === 2 ? "both" : pair.watch[0]))))))));
    return {
      title: `${a} and ${b}`,
      node: [
        h("div", { class: "lede" }, h("h1", {}, "Compare two agents"), h("p", {}, `Every point is one seed of ${where.world.name}, level ${task.label}: the same episode for both.${content.replays.length ? " Filled points lead to it." : ""}`)),
        ns.parts.tabs({ ...where }, "compare", { a, b }),
        h("div", { class: "pair" }, h("label", {}, h("span", { class: "soft" }, "across"), ns.parts.select("First agent", options, a, choose("a"))), h("label", {}, h("span", { class: "soft" }, "upward"), ns.parts.select("Second agent", options, b, choose("b")))),
        pairs.length ? h("div", { class: "comparing" }, h("figure", {}, chart(where, content, a, b, pairs, measure)), h("div", {}, verdict(a, b, pairs, measure), list)) : h("p", {}, "These agents have no seed in common."),
      ],
    };
  };
})();

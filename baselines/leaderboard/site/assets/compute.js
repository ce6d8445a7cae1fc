// Score against cost: compute time of a step, or environment steps of tuning and training.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h, s, plots } = ns;
  const COSTS = {
    time: { title: "compute time, µs a step", value: (row) => (row.stepSeconds === null ? null : row.stepSeconds * 1e6) },
    tuning: { title: "environment steps of tuning or training", value: (row) => row.tuningSteps },
  };

  const SPOTS = [[9, 4, "start"], [-9, 4, "end"], [0, -9, "middle"], [0, 17, "middle"], [9, -7, "start"], [9, 15, "start"], [-9, -7, "end"], [-9, 15, "end"]];

  // A label beside its point that covers no other one. Labels of points on the line stand above it.
  function place(taken, box, x, y, width, front) {
    for (const [dx, dy, anchor] of front ? [SPOTS[6], SPOTS[2], ...SPOTS] : SPOTS) {
      const left = x + dx - (anchor === "end" ? width : anchor === "middle" ? width / 2 : 0);
      const area = [left, y + dy - 10, left + width, y + dy + 3];
      if (area[0] < box.left || area[2] > box.right + 14 || area[1] < box.top - 14 || area[3] > box.bottom) continue;
      if (taken.some((other) => area[0] < other[2] && other[0] < area[2] && area[1] < other[3] && other[1] < area[3])) continue;
      taken.push(area);
      return [x + dx, y + dy, anchor];
    }
    return null;
  }

  ns.views.compute = (where) => {
    const { world, task } = where;
    const width = Math.max(560, Math.min(1264, innerWidth - 56)), height = Math.max(420, Math.min(560, 0.44 * width));
    const box = { left: 60, right: width - 16, top: 30, bottom: height - 52 };
    const cost = COSTS[where.parameters.get("cost")] ? where.parameters.get("cost") : "time";
    const scored = task ? task.scored : world.overall.length > 0;
    const only = task ?? world.tasks[0];
    const measure = only.measures.find((one) => one.column === only.headline);
    const total = new Map(world.overall.map((row) => [row.agent, row.score]));
    const source = task || !world.overall.length ? only.rows : [...new Map(world.tasks.flatMap((one) => one.rows).map((row) => [row.agent, row])).values()];
    const good = scored || measure.highIsGood;
    const rows = source.map((row) => {
      const value = task || !world.overall.length ? (scored ? row.score : row.measures[only.headline]?.map((one) => (one === null ? null : one * measure.factor))) : total.get(row.agent);
      return { ...row, value, cost: COSTS[cost].value(row) };
    }).filter((row) => row.value && row.cost !== null);
    const free = rows.some((row) => row.cost === 0);
    const costs = rows.map((row) => row.cost).filter((value) => value > 0);
    const low = Math.min(...costs) / 1.4, high = Math.max(...costs) * 1.4;
    const range = plots.forestRange(rows.map((row) => row.value), good);
    const start = free ? box.left + 60 : box.left + 10;
    const scale = plots.logarithmic(low, high, start, box.right - 20);
    const x = (value) => (value > 0 ? scale(value) : box.left + 24);
    const y = plots.linear(range[0], range[1], box.bottom, box.top);
    const clip = (value) => Math.min(Math.max(y(value), box.top), box.bottom);
    const digits = scored ? 2 : measure.digits;
    const svg = s("svg", { class: "chart wide", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${scored ? "Score" : measure.heading} against ${COSTS[cost].title}; the same numbers stand in the table of the board` });
    plots.axes(svg, { box, x, y, xTicks: [...(free ? [0] : []), ...plots.logTicks(low, high)], yTicks: plots.ticks(range[0], range[1], 6), xTitle: COSTS[cost].title, yTitle: scored ? "score" : `${measure.heading} ${measure.unit}`,
      xText: (value) => (cost === "tuning" ? ns.count(value) : String(Number(value.toPrecision(2)))), yText: (value) => ns.fixed(value, digits) });
    // Agents that no cheaper one surpasses, without those that see the truth.
    let best = good ? -Infinity : Infinity;
    const front = [];
    for (const row of rows.filter((one) => !one.privileged && one.value[0] >= range[0] && one.value[0] <= range[1]).sort((p, q) => p.cost - q.cost || (good ? q.value[0] - p.value[0] : p.value[0] - q.value[0]))) {
      if (good ? row.value[0] > best : row.value[0] < best) { front.push(row); best = row.value[0]; }
    }
    if (front.length > 1) svg.append(s("path", { class: "front", d: front.map((row, k) => (k ? `H${x(row.cost)}V${clip(row.value[0])}` : `M${x(row.cost)} ${clip(row.value[0])}`)).join("") + `H${box.right}` }));
    const taken = rows.map((row) => [x(row.cost) - 6, clip(row.value[0]) - 6, x(row.cost) + 6, clip(row.value[0]) + 6]);
    for (const row of rows) {
      const [px, py] = [x(row.cost), clip(row.value[0])], kind = ns.kind(row.information), outside = py !== y(row.value[0]);
      if (row.value[1] !== null && !outside) svg.append(s("line", { class: `whisker ${kind}`, x1: px, x2: px, y1: clip(row.value[1]), y2: clip(row.value[2]) }));
      svg.append(outside ? s("path", { class: `mark ${kind}`, d: good ? `M${px} ${py}l-5 -8h10z` : `M${px} ${py}l-5 8h10z` }) : s("circle", { class: `mark ${kind}`, cx: px, cy: py, r: 5 }));
    }
    for (const row of [...rows].sort((p, q) => front.includes(q) - front.includes(p))) {
      const spot = place(taken, box, x(row.cost), clip(row.value[0]), 6.4 * row.agent.length + 4, front.includes(row));
      if (spot) svg.append(s("text", { class: `label${front.includes(row) ? " strong" : ""}`, x: spot[0], y: spot[1], "text-anchor": spot[2] }, row.agent));
    }
    const present = Object.keys(ns.CLASSES).filter((name) => rows.some((row) => ns.kind(row.information) === name));
    return {
      title: "Cost",
      node: [
        h("div", { class: "lede" }, h("h1", {}, "What a score costs"), h("p", {}, `${task ? `Level ${task.label}` : world.overall.length ? "All levels" : `Level ${only.label}`} of ${world.name}. The line joins the agents that no cheaper one surpasses, those that see the truth left out.`)),
        ns.parts.tabs(where, "compute", { cost }),
        h("div", { class: "filters" }, h("div", { class: "chips", role: "group", "aria-label": "Cost" }, Object.entries({ time: "compute time", tuning: "tuning steps" }).map(([name, text]) => h("a", { class: "chip", href: ns.address("compute", { ...where.names, cost: name }), "aria-current": name === cost ? "true" : null }, text))),
          h("p", { class: "legend" }, present.map((name) => h("span", { class: "key" }, ns.dot(name), name)))),
        h("figure", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Figure" }, svg),
      ],
    };
  };
})();

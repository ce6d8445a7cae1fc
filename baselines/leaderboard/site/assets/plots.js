// Scales, axes and interval marks of the page's figures, as SVG.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { s } = ns;

  // Round numbers that cover [low, high], about `count` of them.
  function ticks(low, high, count) {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return found;
  }

  function logTicks(low, high) {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
      for (const k of [1, 2, 5]) if (k * 10 ** power >= low * 0.999 && k * 10 ** power <= high * 1.001) found.push(k * 10 ** power);
    }
    return found.length > 8 ? found.filter((value) => Math.abs(Math.log10(value) % 1) < 1e-9) : found;
  }

  const linear = (low, high, from, to) => (value) => from + ((to - from) * (value - low)) / (high - low);
  const logarithmic = (low, high, from, to) => (value) => from + ((to - from) * Math.log(value / low)) / Math.log(high / low);

  // Range of a forest plot: it holds the intervals of all that are near the best; the others are cut off with an arrow.
  function forestRange(intervals, highIsGood) {
    const given = intervals.filter(Boolean);
    if (!given.length) return [0, 1];
    const best = highIsGood ? Math.max(...given.map((i) => i[0])) : Math.min(...given.map((i) => i[0]));
    const middle = given.map((i) => i[0]).sort((a, b) => a - b)[Math.floor(given.length / 2)];
    const reach = Math.max(2.5 * Math.abs(best - middle), 1e-6 * Math.abs(best));
    const near = given.filter((i) => Math.abs(i[0] - best) <= reach);
    const low = Math.min(...near.map((i) => i[1] ?? i[0])), high = Math.max(...near.map((i) => i[2] ?? i[0]));
    const pad = 0.06 * (high - low || Math.abs(high) || 1);
    return [low - pad, high + pad];
  }

  // One row of a forest plot: a dot and its interval on the common axis; the numbers stand in the cell beside it.
  function forestRow(interval, range, kind, marks, width, height) {
    const x = linear(range[0], range[1], 6, width - 6), middle = height / 2;
    const cut = (value) => Math.min(Math.max(x(value), 2), width - 2);
    const svg = s("svg", { class: "forest", viewBox: `0 0 ${width} ${height}`, width, height, "aria-hidden": "true" });
    for (const mark of marks) svg.append(s("line", { class: "rule", x1: x(mark), x2: x(mark), y1: 0, y2: height }));
    if (!interval) return svg;
    const [value, low, high] = interval;
    if (value < range[0] || value > range[1]) {
      const at = value < range[0] ? 4 : width - 4, way = value < range[0] ? 6 : -6;
      svg.append(s("path", { class: `mark ${kind}`, d: `M${at} ${middle}l${way} -4v8z` }));
      return svg;
    }
    if (low !== null) svg.append(s("line", { class: `whisker ${kind}`, x1: cut(low), x2: cut(high), y1: middle, y2: middle }));
    svg.append(s("circle", { class: `mark ${kind}`, cx: x(value), cy: middle, r: 3.6 }));
    return svg;
  }

  function forestAxis(range, marks, width, digits) {
    const x = linear(range[0], range[1], 6, width - 6);
    return s("svg", { class: "forest axis", viewBox: `0 0 ${width} 16`, width, height: 16, "aria-hidden": "true" },
      marks.map((mark) => s("text", { x: Math.min(Math.max(x(mark), 12), width - 12), y: 12, "text-anchor": "middle" }, ns.fixed(mark, digits))));
  }

  // Frame of a scatter plot with grid lines, numbers and titles.
  function axes(svg, { box, x, y, xTicks, yTicks, xTitle, yTitle, xText, yText }) {
    for (const tick of xTicks) {
      svg.append(s("line", { class: "grid", x1: x(tick), x2: x(tick), y1: box.top, y2: box.bottom }),
        s("text", { class: "tick", x: x(tick), y: box.bottom + 16, "text-anchor": "middle" }, xText(tick)));
    }
    for (const tick of yTicks) {
      svg.append(s("line", { class: "grid", x1: box.left, x2: box.right, y1: y(tick), y2: y(tick) }),
        s("text", { class: "tick", x: box.left - 7, y: y(tick) + 4, "text-anchor": "end" }, yText(tick)));
    }
    svg.append(
      s("text", { class: "title", x: (box.left + box.right) / 2, y: box.bottom + 36, "text-anchor": "middle" }, xTitle),
      s("text", { class: "title", x: box.left - 40, y: box.top - 10, "text-anchor": "start" }, yTitle));
  }

  ns.plots = { ticks, logTicks, linear, logarithmic, forestRange, forestRow, forestAxis, axes };
})();

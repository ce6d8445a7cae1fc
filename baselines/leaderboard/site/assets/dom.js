// Elements, numbers as text, color scheme. All text reaches the page as text nodes and attributes, never as markup.
(function () {
  "use strict";
  const ns = (window.servotrack = window.servotrack || {});
  const SVG = "http://www.w3.org/2000/svg";

  function fill(node, properties, children) {
    for (const [name, value] of Object.entries(properties || {})) {
      if (value === null || value === undefined || value === false) continue;
      if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
      else if (name === "value" || name === "checked" || name === "disabled") node[name] = value;
      else node.setAttribute(name, value === true ? "" : String(value));
    }
    for (const child of children.flat(Infinity)) {
      if (child === null || child === undefined || child === false) continue;
      node.append(child instanceof Node ? child : document.createTextNode(String(child)));
    }
    return node;
  }

  // An element with attributes (on...: listeners) and children (nodes or text).
  const h = (tag, properties, ...children) => fill(document.createElement(tag), properties, children);
  const s = (tag, properties, ...children) => fill(document.createElementNS(SVG, tag), properties, children);

  const fixed = (value, digits) => (value === null || value === undefined ? "" : (Number(value.toFixed(digits)) === 0 ? (0).toFixed(digits) : value.toFixed(digits).replace("-", "−")));

  function count(value) {
    if (value === null || value === undefined) return "?";
    if (value >= 1e6) return `${(value / 1e6).toFixed(value >= 1e7 ? 0 : 1)} M`;
    return value >= 1e3 ? `${Math.round(value / 1e3)} k` : String(value);
  }

  const micro = (seconds) => (seconds === null || seconds === undefined ? "" : (seconds * 1e6).toFixed(seconds < 1e-5 ? 1 : 0));

  // A measure of the board in its table's unit.
  const measured = (value, measure) => fixed(value === null ? null : value * measure.factor, measure.digits);
  const withUnit = (value, measure) => `${measured(value, measure)} ${measure.unit}`.trim();

  const length = (meters) => (meters < 0.1 ? `${(1000 * meters).toFixed(1)} mm` : `${meters.toFixed(2)} m`);

  const CLASSES = {
    "model-free": "no model",
    structure: "knows the form of the model",
    prior: "knows the ranges of the randomization",
    calibrated: "knows this system's parameters",
    privileged: "sees the truth",
    undeclared: "not declared",
  };
  // Names of classes come from files: only known ones become part of a class attribute.
  const kind = (information) => (information in CLASSES ? information : "undeclared");
  const dot = (information) => h("span", { class: `dot ${kind(information)}`, "aria-hidden": "true" });

  const PROOFS = {
    replayed: ["✓", "The action traces were replayed and every number computed again."],
    "re-run": ["✓✓", "The agent itself was run again in a sandbox and acted alike."],
    "self-reported": ["○", "Rows as their maker wrote them; nothing was checked."],
  };
  function badge(row) {
    const proof = row.proof in PROOFS ? row.proof : "self-reported";
    return [
      h("span", { class: `badge ${proof}`, title: PROOFS[proof][1] }, h("span", { "aria-hidden": "true" }, PROOFS[proof][0]), h("span", { class: "word" }, ` ${proof}`)),
      row.stale && [" ", h("span", { class: "badge stale", title: "The package's rollouts have changed since: the numbers belong to an earlier version." }, "stale")],
    ];
  }

  // Color scheme: the reader's, unless chosen here. Storage may be forbidden, as from file:// in some browsers.
  const dark = matchMedia("(prefers-color-scheme: dark)"), root = document.documentElement;
  const kept = () => { try { return localStorage.getItem("servotrack-scheme"); } catch { return null; } };
  let chosen = ["dark", "light"].find((name) => name === kept()) ?? null;
  const apply = () => { root.dataset.scheme = chosen ?? (dark.matches ? "dark" : "light"); };
  const scheme = {
    get() { return root.dataset.scheme; },
    set(name) {
      chosen = name;
      try { localStorage.setItem("servotrack-scheme", name); } catch { /* not kept */ }
      apply();
      window.dispatchEvent(new Event("schemechange"));
    },
  };
  apply();
  dark.addEventListener("change", () => { apply(); window.dispatchEvent(new Event("schemechange")); });

  // A color of the style sheet.
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

  const calm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

  // Address of a view: "#/watch?agent=ppo&seed=200000".
  function address(view, parameters) {
    const query = new URLSearchParams();
    for (const [name, value] of Object.entries(parameters || {})) if (value !== null && value !== undefined && value !== "") query.set(name, value);
    const text = query.toString();
    return `#/${view}${text ? `?${text}` : ""}`;
  }

  Object.assign(ns, { h, s, fixed, count, micro, measured, withUnit, length, CLASSES, PROOFS, kind, dot, badge, scheme, color, calm, address });
})();

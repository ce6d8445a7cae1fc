// Where every row comes from, and what its badge means.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h } = ns;

  ns.views.proof = () => {
    const board = ns.data.board();
    const rows = board.suites.flatMap((suite) => suite.worlds.flatMap((world) => world.tasks.flatMap((task) => task.rows.map((row) => ({ ...row, suite: suite.name })))));
    const agents = new Map();
    for (const row of rows) {
      const key = JSON.stringify([row.suite, row.agent]);
      const seen = agents.get(key) ?? { ...row, episodes: 0, cells: 0, stale: false };
      seen.episodes += row.episodes;
      seen.cells += 1;
      seen.stale ||= row.stale;
      agents.set(key, seen);
    }
    return {
      title: "Proof",
      node: [
        h("div", { class: "lede" }, h("h1", {}, "Where the rows come from"), h("p", {}, "A row is believed as far as its badge goes. A replayed trace proves the score, not that a causal agent made it; a re-run proves both.")),
        h("dl", { class: "facts" }, Object.entries(ns.PROOFS).map(([name, [, text]]) => [h("dt", {}, ns.badge({ proof: name })), h("dd", {}, text)]),
          h("dt", {}, h("span", { class: "badge stale" }, "stale")), h("dd", {}, "The package's rollouts have changed since the row was made. It stays until it is made again.")),
        h("h2", {}, "Information classes"),
        h("dl", { class: "facts" }, Object.entries(ns.CLASSES).map(([name, text]) => [h("dt", {}, ns.dot(name), name), h("dd", {}, text)])),
        h("h2", {}, "Rows"),
        h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Provenance" }, h("table", { class: "board slim left" },
          h("thead", {}, h("tr", {}, ["agent", "proof", "description", "episodes", "made", "version", "machine"].map((title) => h("th", { scope: "col" }, title)))),
          h("tbody", {}, [...agents.values()].map((row) => {
            const facts = board.agents[row.agent] ?? {};
            return h("tr", {}, h("th", { scope: "row" }, ns.dot(row.information), row.agent), h("td", {}, ns.badge(row)), h("td", { class: "text" }, facts.summary), h("td", {}, `${row.episodes} in ${row.cells} ${row.cells === 1 ? "cell" : "cells"}`), h("td", {}, (facts.created ?? "").slice(0, 10)), h("td", {}, facts.version), h("td", {}, [facts.machine.split("-")[0], facts.engine].filter(Boolean).join(", ")));
          })))),
      ],
    };
  };
})();

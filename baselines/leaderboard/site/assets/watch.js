// One episode, or the same seed by two agents.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h } = ns;

  function side(where, content, replay, agent) {
    const { task } = where;
    const measure = task.measures.find((given) => given.column === task.headline);
    const own = content.replays.filter((given) => given.agent === agent);
    const order = (given) => (given.labels.length ? ["best", "median", "worst"].indexOf(given.labels[0]) : 3);
    own.sort((a, b) => order(a) - order(b) || a.seed - b.seed);
    const other = where.parameters.get("with");
    const links = own.map((given) => h("li", {}, h("a", { href: ns.address("watch", { ...where.names, agent, seed: given.seed, with: other }), "aria-current": given === replay ? "true" : null },
      h("span", { class: "which" }, given.labels.join(", ") || "shared"), h("span", {}, `seed ${given.seed}`), h("span", { class: "value" }, ns.withUnit(given.value, measure)))));
    const rivals = task.rows.map((row) => row.agent).filter((name) => name !== agent && content.replays.some((given) => given.agent === name && given.seed === replay.seed));
    const against = ns.parts.select("Compare with", [["", "nobody"], ...rivals.map((name) => [name, name])], rivals.includes(other) ? other : "", (name) => { location.hash = ns.address("watch", { ...where.names, agent, seed: replay.seed, with: name }); });
    const agents = ns.parts.select("Agent", task.rows.filter((row) => content.replays.some((given) => given.agent === row.agent)).map((row) => [row.agent, row.agent]), agent, (name) => { location.hash = ns.address("watch", { ...where.names, agent: name, seed: content.replays.some((given) => given.agent === name && given.seed === replay.seed) ? replay.seed : null, episode: "worst" }); });
    return h("aside", { class: "side", "aria-label": "Episodes" },
      h("div", { class: "pair" }, h("label", {}, h("span", { class: "soft" }, "agent"), agents), h("label", {}, h("span", { class: "soft" }, "beside"), against)),
      h("h2", {}, "Episodes"), h("ul", { class: "episodes" }, links),
      other && rivals.includes(other) && h("p", {}, h("a", { href: ns.address("compare", { ...where.names, a: agent, b: other }) }, `Compare ${agent} and ${other} on all seeds`)));
  }

  ns.views.watch = async (where) => {
    const task = where.task ?? where.world.tasks[0];
    where = { ...where, task, names: { ...where.names, task: task.name } };
    const content = await ns.data.unpacked(task.chunk);
    const given = where.parameters;
    const mine = (agent) => content.replays.filter((replay) => replay.agent === agent);
    const agent = mine(given.get("agent")).length ? given.get("agent") : (task.rows.find((row) => !row.privileged && mine(row.agent).length)?.agent ?? content.replays[0]?.agent);
    if (!agent) return { node: [ns.parts.tabs(where, "watch"), h("p", {}, "No episode of this task can be watched.")], title: "Watch" };
    const wanted = Number(given.get("seed")), which = given.get("episode") || "worst";
    const replay = mine(agent).find((one) => given.get("seed") && one.seed === wanted) ?? mine(agent).find((one) => one.labels.includes(which)) ?? mine(agent)[0];
    const other = content.replays.find((one) => one.agent === given.get("with") && one.agent !== agent && one.seed === replay.seed);
    const shown = [{ replay, tint: ns.color("tool"), name: agent }];
    if (other) shown.push({ replay: other, tint: ns.color("second"), name: other.agent });
    const kind = replay.labels.length ? `${replay.labels.join(" and ")} episode` : `seed ${replay.seed}`;
    const title = `${agent}: ${kind}`;
    const player = ns.player.player(`${title}, ${task.name}`, shown, true);
    const { scene } = replay, sets = scene.form !== "arm";
    const legend = h("p", { class: "legend" }, h("span", { class: "key target" }, sets ? "true targets" : "target"), shown.map(({ name }, k) => h("span", { class: `key ${k ? "second" : "tool"}` }, name)),
      scene.measured && h("span", { class: "soft" }, "× measurements"), sets && !other && h("span", { class: "soft" }, "on the map every identity has a color of its own"));
    return {
      title,
      node: [
        h("div", { class: "lede" }, h("h1", {}, agent, h("span", { class: "soft" }, ` ${kind}${replay.labels.length ? `, seed ${replay.seed}` : ""}${other ? `, beside ${other.agent}` : ""}`)), h("p", {}, `${task.level === null ? task.name : `${where.world.name}, level ${task.label}`}. `, shown.map(({ replay: one, name }) => `${ns.stages.of(one.scene).sentence(one, name)} `))),
        ns.parts.tabs(where, "watch", { agent, episode: which }),
        h("div", { class: "watching" }, h("div", {}, legend, player.node), side(where, content, replay, agent)),
      ],
      leave: player.stop,
    };
  };
})();

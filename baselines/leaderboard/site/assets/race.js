// The visitor drives the arm against recorded agents on the same seed.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h, scene: paint, stages: { arm: stage }, arm: arms } = ns;
  const STEADY = 61; // first sample after 3 s, counted from the end of the warm-up
  const SUCCESS = [0.01, 0.025]; // m: mean and 95th percentile after 3 s
  const GAIN = 12; // 1/s: the tool goes to the pointer this fast
  const DAMPING = 0.02; // m: keeps rates finite where the arm is stretched
  const KEY_RATE = 0.6; // share of the largest joint rate that an arrow key commands
  const STICK = 0.3; // share of the picture's width that commands the largest rate
  const KEYS = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowUp: [1, 1], ArrowDown: [1, -1] };
  const MODES = {
    point: ["follow the pointer", "The tool goes where you point, by the arm's true lengths. Arrow keys turn the joints."],
    joints: ["drive the joints", "Across: the shoulder, up and down: the elbow; away from the middle is faster. Or hold arrow keys."],
    camera: ["camera only", "What the agents see: the target, and the ring it belongs into. You command joint rates, without knowing how the camera is mounted."],
  };
  const TINTS = ["tool", "second", "third"];
  const kept = { mode: "point", best: new Map() };

  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

  // Errors as the benchmark counts them, those after an early end as large as its last one or `lost`; null before 3 s.
  function counted(errors, scene, until, lost) {
    const late = Array.from(errors.slice(scene.warmup + STEADY, until + 1));
    const missing = until + 1 - Math.max(errors.length, scene.warmup + STEADY);
    if (missing > 0) late.push(...new Array(missing).fill(Math.max(errors[errors.length - 1], lost)));
    if (!late.length) return null;
    const sorted = [...late].sort((a, b) => a - b), place = 0.95 * (sorted.length - 1), k = Math.floor(place);
    const p95 = sorted[k] + (place - k) * ((sorted[k + 1] ?? sorted[k]) - sorted[k]);
    const steady = mean(late);
    return { steady, success: steady < SUCCESS[0] && p95 < SUCCESS[1] };
  }

  // Joint rates that bring the tool towards a point, as shares of the largest rate, the direction kept.
  function pursue(arm, point) {
    const [t1, t2] = arm.joints, [l1, l2] = arm.links, tool = arm.tool();
    const vx = GAIN * (point[0] - tool[0]), vy = GAIN * (point[1] - tool[1]);
    const b1 = -l2 * Math.sin(t1 + t2), b2 = l2 * Math.cos(t1 + t2), a1 = -l1 * Math.sin(t1) + b1, a2 = l1 * Math.cos(t1) + b2;
    // Damped least squares: (J' J + d^2 I) rates = J' v.
    const d = DAMPING * DAMPING, m11 = a1 * a1 + a2 * a2 + d, m12 = a1 * b1 + a2 * b2, m22 = b1 * b1 + b2 * b2 + d;
    const u = a1 * vx + a2 * vy, v = b1 * vx + b2 * vy, det = m11 * m22 - m12 * m12;
    const rates = [(m22 * u - m12 * v) / det, (m11 * v - m12 * u) / det];
    const most = Math.max(1, Math.abs(rates[0]) / arm.maxRate, Math.abs(rates[1]) / arm.maxRate);
    return rates.map((rate) => rate / arm.maxRate / most);
  }

  ns.views.race = async (where) => {
    const race = await ns.data.load("race");
    const given = where.parameters;
    const entry = race.courses.find((one) => one.task === given.get("course")) ?? race.courses.find((one) => one.level === 3) ?? race.courses[0];
    entry.unpacked ??= ns.data.unpack(entry);
    const course = await entry.unpacked;
    const seed = course.seeds.includes(Number(given.get("seed"))) ? Number(given.get("seed")) : course.seeds[0];
    const scene = course.scenes.get(seed);
    const rivals = race.racers.map((name) => course.replays.find((replay) => replay.agent === name && replay.seed === seed));
    const steps = scene.path[0].length - 1;
    let mode = MODES[given.get("mode")] ? given.get("mode") : kept.mode;

    // State of the run: "waiting" (the rivals drive alone), "counting", "running", "over".
    let phase = "waiting", arm, joints, tools, errors, pointer = null, since = 0, sample = 0, frame = 0, gone = false, idle = performance.now();
    const held = new Set();
    const stats = (ns.raceStats = { frames: 0, started: 0, ended: 0, slowest: 0, drawing: 0 });

    const canvases = stage.make("Race");
    const overlay = h("div", { class: "overlay" });
    const live = h("p", { class: "visually-hidden", role: "status" });
    const hint = h("p", { class: "hint" });
    const above = canvases.floor.parentNode, lens = canvases.camera.parentNode;
    above.append(overlay);
    canvases.node.classList.add("arena");

    function reset() {
      arm = new arms.Arm(scene.links, entry.settings, scene.gain);
      joints = [arm.joints];
      tools = [arm.tool()];
      errors = [Math.hypot(tools[0][0] - scene.path[0][0], tools[0][1] - scene.path[1][0])];
      sample = 0;
    }

    function command() {
      const keys = [0, 0];
      for (const key of held) keys[KEYS[key][0]] += KEYS[key][1] * KEY_RATE;
      if (keys[0] || keys[1]) return keys;
      if (!pointer) return [0, 0];
      if (mode === "point") return pursue(arm, pointer.floor);
      return pointer.stick;
    }

    function advance() {
      const k = joints.length - 1;
      joints.push(arm.step(command(), scene.noise ? [scene.noise[0][k], scene.noise[1][k]] : null));
      tools.push(arm.tool());
      errors.push(Math.hypot(tools[k + 1][0] - scene.path[0][k + 1], tools[k + 1][1] - scene.path[1][k + 1]));
    }

    function draw(at) {
      const target = stage.targetAt(scene, at), k = Math.min(Math.floor(at), joints.length - 1), next = Math.min(k + 1, joints.length - 1);
      const mine = joints[k].map((value, j) => value + Math.min(at - k, 1) * (joints[next][j] - value));
      const here = phase === "waiting" ? joints[0] : mine;
      const actors = [{ joints: here, trail: phase === "waiting" ? [] : [...stage.past(tools, Math.min(at, joints.length - 1)), arms.tool(scene.links, here)], tint: ns.color(TINTS[0]), ghost: false }];
      rivals.forEach((replay, n) => {
        const pose = stage.jointsAt(replay, at);
        actors.push({ joints: pose, trail: [...stage.past(stage.tools(replay), Math.min(at, replay.length - 1)).slice(-40), arms.tool(scene.links, pose)], tint: ns.color(TINTS[n + 1]), ghost: true });
      });
      const targetTrail = [...stage.past(stage.pathOf(scene), at), target];
      if (mode !== "camera" || phase !== "running") paint.floor(canvases.floor, { scene, actors, target, targetTrail, pointer: phase === "running" && mode === "point" ? pointer?.floor : null });
      const view = ns.camera.pose(scene.camera, scene.links, here);
      const seen = ns.camera.project(scene.camera, view, ...target);
      paint.camera(canvases.camera, { scene, joints: here, target, targetTrail: phase === "running" ? trailOf(seen) : [], unseen: false });
      stick();
      if (!stats.picture) stats.picture = performance.now();
      if (phase === "running" && Math.floor(at) === written) return;
      // What follows changes with the samples, 20 times a second.
      const series = rivals.map((replay, n) => ({ errors: replay.errors, tint: ns.color(TINTS[n + 1]) })).reverse();
      paint.errors(canvases.errors, { scene, steps, now: at, series: phase === "waiting" ? series : [...series, { errors: errors.slice(0, Math.floor(at) + 1), tint: ns.color(TINTS[0]) }] });
      board(Math.floor(at));
    }

    let spots = [];
    function trailOf(seen) {
      spots.push(seen);
      if (spots.length > 200) spots.shift();
      return spots;
    }

    // The middle of the stick: that of the floor, or the goal in the camera's view.
    const middle = (width) => (mode === "camera" ? scene.goal.map((value) => (value * width) / scene.size) : [width / 2, width / 2]);

    // The stick: a ring about its middle, and the command as a line from it.
    function stick() {
      if (phase !== "running" || mode === "point") return;
      const canvas = mode === "camera" ? canvases.camera : canvases.floor, pen = canvas.getContext("2d"), c = paint.colors();
      const width = canvas.clientWidth, action = command(), reach = STICK * width, [u, v] = middle(width);
      pen.strokeStyle = mode === "camera" ? c["lens-ink"] : c.ink;
      pen.globalAlpha = 0.55;
      pen.lineWidth = 1.2;
      pen.beginPath();
      pen.arc(u, v, reach, 0, 2 * Math.PI);
      pen.stroke();
      pen.lineWidth = 3;
      pen.lineCap = "round";
      pen.beginPath();
      pen.moveTo(u, v);
      pen.lineTo(u + action[0] * reach, v - action[1] * reach);
      pen.stroke();
      pen.globalAlpha = 1;
    }

    const lanes = [["you", TINTS[0]], ...race.racers.map((name, n) => [name, TINTS[n + 1]])].map(([name, tint]) => {
      const now = h("td"), late = h("td");
      return { now, late, node: h("tr", {}, h("th", { scope: "row" }, h("span", { class: `key ${tint}` }, name)), now, late) };
    });
    const standings = h("table", { class: "standings" }, h("caption", { class: "visually-hidden" }, "Errors of the racers"), h("thead", {}, h("tr", {}, ["", "now", "mean after 3 s"].map((title) => h(title ? "th" : "td", title ? { scope: "col" } : {}, title)))), h("tbody", {}, lanes.map((lane) => lane.node)));
    lens.before(standings);
    let written = -1;
    function board(k) {
      written = k;
      [phase === "waiting" ? null : errors, ...rivals.map((replay) => replay.errors)].forEach((values, n) => {
        const sum = values && counted(values, scene, k, race.lost);
        lanes[n].now.textContent = values ? ns.length(values[Math.min(k, values.length - 1)]) : "–";
        lanes[n].late.textContent = sum ? ns.length(sum.steady) : "–";
      });
    }

    function tick(now) {
      if (gone) return;
      if (phase === "waiting") {
        if (!ns.calm()) draw((Math.max(0, now - idle) / 1000 / arms.PERIOD) % steps);
      } else if (phase === "running") {
        if (stats.frames) stats.slowest = Math.max(stats.slowest, now - stats.last);
        stats.last = now;
        stats.frames += 1;
        sample = Math.max(0, (now - since) / 1000 / arms.PERIOD);
        // A page in the background gets no frames: the race waits for it.
        if (sample > joints.length + 10) { since += (sample - joints.length) * arms.PERIOD * 1000; sample = joints.length; }
        const begun = performance.now();
        while (joints.length - 1 < Math.min(Math.floor(sample) + 1, steps)) advance();
        draw(Math.min(sample, steps));
        stats.drawing += performance.now() - begun;
        if (sample >= steps) finish();
      }
      frame = requestAnimationFrame(tick);
    }

    function start() {
      reset();
      spots = [];
      phase = "counting";
      canvases.node.classList.toggle("only-camera", mode === "camera");
      canvases.node.classList.add("running");
      (mode === "camera" ? lens : above).append(overlay);
      written = -1;
      draw(0);
      let left = 3;
      const count = () => {
        if (gone || phase !== "counting") return;
        if (left > 0) {
          overlay.replaceChildren(h("span", { class: "count", "aria-hidden": "true" }, left));
          left -= 1;
          setTimeout(count, 650);
          return;
        }
        overlay.replaceChildren();
        overlay.hidden = true;
        phase = "running";
        live.textContent = "Go";
        since = performance.now();
        Object.assign(stats, { frames: 0, started: since, ended: 0, slowest: 0, drawing: 0 });
      };
      count();
      canvases.floor.focus({ preventScroll: true });
      overlay.parentNode.scrollIntoView({ block: "nearest", behavior: ns.calm() ? "auto" : "smooth" });
    }

    function finish() {
      phase = "over";
      stats.ended = performance.now();
      canvases.node.classList.remove("only-camera", "running");
      above.append(overlay);
      const mine = counted(errors, scene, steps, race.lost);
      const others = rivals.map((replay) => counted(replay.errors, scene, steps, race.lost));
      const anchors = entry.anchors;
      const score = (error) => (anchors ? Math.log((anchors[0] + anchors[2]) / (error + anchors[2])) / Math.log((anchors[0] + anchors[2]) / (anchors[1] + anchors[2])) : null);
      const list = [["you", mine.steady, mine.success, TINTS[0]], ...race.racers.map((name, n) => [name, others[n].steady, others[n].success, TINTS[n + 1]])].sort((p, q) => p[1] - q[1]);
      const place = list.findIndex(([name]) => name === "you");
      const ahead = list[0][0] === "you" ? list[1] : list[0];
      const ratio = Math.max(mine.steady, ahead[1]) / Math.min(mine.steady, ahead[1]);
      const times = (value) => value.toFixed(value < 20 ? 1 : 0);
      const verdict = place === 0 ? "You win. The board wants you." : place === 1 ? `Second: ${ahead[0]} was ${times(ratio)} times closer.` : `Third: ${ahead[0]} was ${times(ratio)} times closer.`;
      live.textContent = `Finished. ${verdict} Your mean error is ${ns.length(mine.steady)}.`;
      const own = `${entry.task} ${seed} ${mode}`, before = kept.best.get(own);
      kept.best.set(own, Math.min(mine.steady, before ?? Infinity));
      const next = course.seeds[(course.seeds.indexOf(seed) + 1) % course.seeds.length];
      overlay.hidden = false;
      const again = h("button", { type: "button", class: "primary", onclick: start }, "Again");
      overlay.replaceChildren(h("div", { class: "card" }, h("h2", {}, verdict),
        h("table", { class: "standings" }, h("thead", {}, h("tr", {}, ["", "mean after 3 s", "score", "success"].map((title) => h(title ? "th" : "td", title ? { scope: "col" } : {}, title)))),
          h("tbody", {}, list.map(([name, error, success, tint]) => h("tr", { class: name === "you" ? "you" : null }, h("th", { scope: "row" }, h("span", { class: `key ${tint}` }, name)), h("td", {}, ns.length(error)), h("td", {}, ns.fixed(score(error), 2)), h("td", {}, success ? "yes" : "no"))))),
        before !== undefined && h("p", { class: "soft" }, mine.steady < before ? `Better than your ${ns.length(before)} before.` : `Your best here: ${ns.length(before)}.`),
        h("p", { class: "buttons" }, again, h("a", { class: "button", href: ns.address("race", { course: entry.task, seed: next, mode }) }, "Next episode"))));
      again.focus({ preventScroll: true });
    }

    function aim(event) {
      const canvas = mode === "camera" ? canvases.camera : canvases.floor, box = canvas.getBoundingClientRect();
      const spot = [event.clientX - box.left, event.clientY - box.top], reach = STICK * box.width;
      const [u, v] = middle(box.width);
      const clip = (value) => Math.min(Math.max(value, -1), 1);
      pointer = { floor: paint.window(scene.links, box.width).from(spot), stick: [clip((spot[0] - u) / reach), clip((v - spot[1]) / reach)] };
    }
    for (const canvas of [canvases.floor, canvases.camera]) {
      canvas.addEventListener("pointermove", aim);
      canvas.addEventListener("pointerdown", (event) => { if (phase === "running") { canvas.setPointerCapture(event.pointerId); aim(event); event.preventDefault(); } });
      canvas.addEventListener("pointerleave", () => { if (mode !== "point") pointer = null; });
      canvas.addEventListener("pointerup", (event) => { if (event.pointerType !== "mouse" && mode !== "point") pointer = null; });
    }
    canvases.floor.tabIndex = -1;
    overlay.addEventListener("pointermove", aim);
    const down = (event) => {
      if (!(event.key in KEYS) || event.target.closest("input, select, textarea")) return;
      if (phase === "running" || phase === "counting") { held.add(event.key); event.preventDefault(); }
    };
    const up = (event) => held.delete(event.key);
    const clear = () => held.clear();
    document.addEventListener("keydown", down);
    document.addEventListener("keyup", up);
    window.addEventListener("blur", clear);
    const redraw = () => { if (phase === "waiting" || phase === "over") draw(phase === "over" ? steps : ns.calm() ? 60 : 0); };
    window.addEventListener("schemechange", redraw);
    const observer = new ResizeObserver(redraw);
    observer.observe(canvases.node);

    const address = (changes) => ns.address("race", { course: entry.task, seed, mode, ...changes });
    const modes = h("div", { class: "chips", role: "group", "aria-label": "Control" }, Object.entries(MODES).map(([name, [text]]) => h("button", { type: "button", class: "chip", "data-mode": name, "aria-pressed": String(name === mode), onclick: () => choose(name) }, text)));
    function choose(name) {
      mode = kept.mode = name;
      hint.textContent = MODES[name][1];
      for (const chip of modes.children) chip.setAttribute("aria-pressed", String(chip.dataset.mode === name));
      if (phase !== "waiting") { wait(); }
    }
    function wait() {
      phase = "waiting";
      idle = performance.now();
      written = -1;
      canvases.node.classList.remove("only-camera", "running");
      above.append(overlay);
      overlay.hidden = false;
      overlay.replaceChildren(h("button", { type: "button", class: "primary start", onclick: start }, "Start"));
      redraw();
    }
    reset();
    choose(mode);
    wait();
    frame = requestAnimationFrame(tick);
    const levels = ns.parts.select("Level", race.courses.map((one) => [one.task, one.level === null ? one.task : `level ${one.level}`]), entry.task, (name) => { location.hash = ns.address("race", { course: name, mode }); });
    const seeds = ns.parts.select("Episode", course.seeds.map((one, k) => [String(one), `episode ${k + 1}, seed ${one}`]), String(seed), (name) => { location.hash = address({ seed: name }); });
    return {
      title: "Race the filter",
      node: [
        h("div", { class: "lede" }, h("h1", {}, "Race the filter"), h("p", {}, `Keep your tool on the orange target for ${Math.round((steps - scene.warmup) * arms.PERIOD * 10) / 10} seconds. `, h("span", { class: "key second" }, race.racers[0]), " and ", h("span", { class: "key third" }, race.racers[1]), " drove the same arm after the same target, and saw it only through an uncalibrated camera.")),
        h("div", { class: "filters" }, modes, levels, seeds), hint,
        canvases.node, live,
        h("p", { class: "note" }, "The physics is the benchmark's own, computed in this page: a solver with the same operations in the same order, which differs from the package by less than a billionth of a radian. Errors count after 3 s, as on the board."),
      ],
      leave() {
        gone = true;
        cancelAnimationFrame(frame);
        observer.disconnect();
        document.removeEventListener("keydown", down);
        document.removeEventListener("keyup", up);
        window.removeEventListener("blur", clear);
        window.removeEventListener("schemechange", redraw);
      },
    };
  };
})();

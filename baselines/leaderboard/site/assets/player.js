// A stage with three pictures, and the controls that play recorded episodes on it.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h, scene: paint } = ns;
  const SPEEDS = [0.25, 0.5, 1, 2, 4];

  // Canvases of a stage, with their frames.
  function stage(label) {
    const picture = (name) => h("canvas", { class: name, role: "img", "aria-label": `${label}: ${{ floor: "the floor from above", camera: "the camera's view", errors: "tracking error over time" }[name]}` });
    const floor = picture("floor"), camera = picture("camera"), errors = picture("errors");
    const side = h("div", { class: "stage-side" },
      h("figure", { class: "lens" }, camera, h("figcaption", {}, "camera, true geometry")),
      h("figure", { class: "strip" }, errors, h("figcaption", {}, "tracking error; shaded: success, below 1 cm")));
    const node = h("div", { class: "stage" }, h("figure", { class: "above" }, floor), side);
    return { node, floor, camera, errors };
  }

  // Tool positions of a replay, computed once.
  function tools(replay) {
    replay.tools ??= Array.from({ length: replay.length }, (_, k) => ns.arm.tool(replay.scene.links, [replay.joints[0][k], replay.joints[1][k]]));
    return replay.tools;
  }

  function pathOf(scene) {
    scene.points ??= Array.from(scene.path[0], (x, k) => [x, scene.path[1][k]]);
    return scene.points;
  }

  const past = (list, at) => list.slice(Math.max(0, Math.floor(at) - ns.scene.TRAIL), Math.floor(at) + 1);

  // Joint angles of a replay at a fractional sample.
  const jointsAt = (replay, at) => [0, 1].map((j) => paint.between(replay.joints[j], Math.min(at, replay.length - 1)));
  const targetAt = (scene, at) => [0, 1].map((j) => paint.between(scene.path[j], at));

  // Show an instant of episodes that share a scene. replays: [{replay, tint}], the first one leads.
  function show(canvases, replays, at) {
    const scene = replays[0].replay.scene, lead = replays[0].replay;
    const target = targetAt(scene, at), joints = jointsAt(lead, at);
    const actors = replays.map(({ replay, tint }, k) => {
      const tool = ns.arm.tool(scene.links, jointsAt(replay, at));
      return { joints: jointsAt(replay, at), trail: [...past(tools(replay), Math.min(at, replay.length - 1)), tool], tint, ghost: k > 0 };
    });
    paint.floor(canvases.floor, { scene, actors, target, targetTrail: [...past(pathOf(scene), at), target] });
    lead.pixels ??= Array.from({ length: lead.length }, (_, k) =>
      ns.camera.project(scene.camera, ns.camera.pose(scene.camera, scene.links, [lead.joints[0][k], lead.joints[1][k]]), scene.path[0][k], scene.path[1][k]));
    const sample = Math.min(Math.floor(at), lead.length - 1);
    let unseen = false;
    for (let k = 0; k < lead.unseen.length; k += 2) unseen ||= lead.unseen[k] <= sample && sample < lead.unseen[k + 1];
    paint.camera(canvases.camera, { scene, joints, target, targetTrail: past(lead.pixels, sample), unseen });
    paint.errors(canvases.errors, { scene, steps: scene.path[0].length - 1, now: at, series: replays.slice().reverse().map(({ replay, tint }) => ({ errors: replay.errors, tint })) });
  }

  // A player of episodes. Returns its node and `stop`, to be called when the view is left.
  function player(label, replays, autoplay) {
    const canvases = stage(label);
    const scene = replays[0].replay.scene;
    const last = Math.max(...replays.map(({ replay }) => replay.length - 1));
    let at = 0, playing = false, speed = 1, before = 0, frame = 0, gone = false;
    const time = h("span", { class: "clock" });
    const button = h("button", { type: "button", class: "play", onclick: () => (playing ? pause() : play()) });
    const slider = h("input", { type: "range", min: 0, max: last, step: 1, value: 0, "aria-label": "Instant of the episode", oninput: () => { pause(); at = Number(slider.value); draw(); } });
    const speeds = h("select", { "aria-label": "Speed", onchange: () => (speed = Number(speeds.value)) }, SPEEDS.map((value) => h("option", { value: String(value) }, `${value}×`)));
    speeds.value = "1";
    const controls = h("div", { class: "controls" }, button, slider, time, speeds);

    function draw() {
      show(canvases, replays, at);
      const seconds = (at - scene.warmup) * ns.arm.PERIOD;
      time.textContent = `${seconds.toFixed(1).replace("-", "−")} s`;
      slider.value = at;
      slider.setAttribute("aria-valuetext", `${seconds.toFixed(1)} seconds, ` + replays.map(({ replay, name }) => `${name} ${ns.length(replay.errors[Math.min(Math.floor(at), replay.length - 1)])}`).join(", "));
    }
    function tick(now) {
      if (gone) return;
      if (playing) {
        at = Math.min(at + (speed * Math.min(Math.max(now - before, 0), 100)) / 1000 / ns.arm.PERIOD, last);
        before = now;
        draw();
        if (at >= last) pause();
        else frame = requestAnimationFrame(tick);
      }
    }
    function play() {
      if (at >= last) at = 0;
      playing = true;
      before = performance.now();
      label_();
      frame = requestAnimationFrame(tick);
    }
    function pause() {
      playing = false;
      cancelAnimationFrame(frame);
      label_();
    }
    function label_() {
      button.textContent = playing ? "❚❚" : "▶";
      button.setAttribute("aria-label", playing ? "Pause" : "Play");
    }
    const keys = (event) => {
      if (event.target.closest("input, select, button, a, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === " ") (playing ? pause() : play());
      else if (event.key === "ArrowRight" || event.key === "ArrowLeft") { pause(); at = Math.min(Math.max(Math.round(at) + (event.key === "ArrowRight" ? 1 : -1), 0), last); draw(); }
      else return;
      event.preventDefault();
    };
    document.addEventListener("keydown", keys);
    window.addEventListener("schemechange", draw);
    const observer = new ResizeObserver(draw);
    observer.observe(canvases.node);
    label_();
    if (autoplay && !ns.calm()) play();
    else at = Math.min(scene.warmup + 60, last);
    return {
      node: h("div", { class: "player" }, canvases.node, controls),
      stop() {
        gone = true;
        cancelAnimationFrame(frame);
        observer.disconnect();
        document.removeEventListener("keydown", keys);
        window.removeEventListener("schemechange", draw);
      },
    };
  }

  ns.player = { player, stage, show, tools, pathOf, past, jointsAt, targetAt };
})();

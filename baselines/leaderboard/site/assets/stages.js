// Pictures of an instant of an episode, by the form of its scene: an arm over a target, or a set of targets.
// A form has make(label), show(canvases, replays, at), last(replays), start(scene), rate(scene), clock(scene, at),
// spoken(replay, at) and sentence(replay, name).
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h, scene: paint } = ns;

  const picture = (label) => (name, text) => h("canvas", { class: name, role: "img", "aria-label": `${label}: ${text}` });
  const strip = (canvas, ...caption) => h("figure", { class: "strip" }, canvas, h("figcaption", {}, caption));

  // Canvases of an arm, with their frames.
  function makeArm(label) {
    const drawn = picture(label);
    const floor = drawn("floor", "the floor from above"), camera = drawn("camera", "the camera's view"), errors = drawn("errors", "tracking error over time");
    const side = h("div", { class: "stage-side" },
      h("figure", { class: "lens" }, camera, h("figcaption", {}, "camera, true geometry")),
      strip(errors, "tracking error; shaded: success, below 1 cm"));
    return { node: h("div", { class: "stage" }, h("figure", { class: "above" }, floor), side), floor, camera, errors };
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
  function showArm(canvases, replays, at) {
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

  const seconds = (scene, at) => ((at - scene.warmup) * ns.arm.PERIOD).toFixed(1);

  // A sentence on an episode for everybody, and all that a screen reader gets of it.
  function armSentence(replay, name) {
    const { errors, scene } = replay, late = errors.slice(Math.min(scene.warmup + 61, errors.length - 1));
    const mean = late.reduce((sum, error) => sum + error, 0) / late.length;
    let unseen = 0;
    for (let k = 0; k < replay.unseen.length; k += 2) unseen += replay.unseen[k + 1] - replay.unseen[k];
    const early = errors.length < scene.path[0].length;
    return `${name}: the tool starts ${ns.length(errors[0])} from the target; ${early ? `the target is lost and the episode ends after ${((errors.length - 1 - scene.warmup) * ns.arm.PERIOD).toFixed(1)} s` : `after 3 s the mean error is ${ns.length(mean)}, at worst ${ns.length(Math.max(...late))}`}` +
      `${unseen > 1 ? `; ${Math.round((100 * unseen) / errors.length)} % of the frames are lost or do not show the target` : ""}.`;
  }

  const arm = {
    make: makeArm, show: showArm, tools, pathOf, past, jointsAt, targetAt,
    last: (replays) => Math.max(...replays.map(({ replay }) => replay.length - 1)),
    start: (scene) => scene.warmup + 60,
    rate: () => 1 / ns.arm.PERIOD,
    clock: (scene, at) => `${seconds(scene, at).replace("-", "−")} s`,
    spoken: (replay, at) => ns.length(replay.errors[Math.min(Math.floor(at), replay.length - 1)]),
    spokenTime: (scene, at) => `${seconds(scene, at)} seconds`,
    sentence: armSentence,
  };

  // Canvases of a set of targets, with their frames.
  function makeSets(label, scene) {
    const drawn = picture(label), about = scene.form === "bearings" ? "bearings over time" : "the scene from above";
    const map = drawn("map", scene.form === "boxes" ? "boxes in the image" : about), counts = drawn("counts", "number of targets over time"), errors = drawn("errors", "error of each scan");
    const [x0, y0, x1, y1] = scene.window;
    map.style.aspectRatio = scene.form === "boxes" ? `${x1 - x0} / ${y1 - y0}` : "1";
    const what = scene.form === "boxes" && scene.cutoff === 1 && scene.alone ? "1 − overlap" : "OSPA";
    const side = h("div", { class: "stage-side" },
      strip(errors, `${what} of each scan${scene.unit ? `, ${scene.unit}` : ""}`),
      strip(counts, "number of targets: true ones shaded, reported ones as a line"));
    return { node: h("div", { class: "stage sets" }, h("figure", { class: "above" }, map, scene.form === "bearings" && h("figcaption", {}, "bearing to the right, time downward")), side), map, counts, errors };
  }

  function setsSentence(replay, name) {
    const { scene, errors } = replay, mean = (values) => values.reduce((sum, value) => sum + value, 0) / Math.max(values.length, 1);
    const worst = errors.indexOf(Math.max(...errors));
    const tracks = (runs) => new Set(runs.map((run) => run.id)).size;
    const many = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
    return `${name}: ${mean(replay.numbers).toFixed(1)} targets reported where ${mean(scene.numbers).toFixed(1)} are; ${many(tracks(replay.runs), "track")} for ${many(tracks(scene.truth), "target")}; ` +
      `the error of a scan is ${ns.withUnit(mean(Array.from(errors)), ns.sets.measure(scene))}, at worst ${ns.withUnit(errors[worst], ns.sets.measure(scene))} in scan ${worst + 1}.`;
  }

  const sets = {
    make: makeSets,
    show: (canvases, replays, at) => ns.sets.show(canvases, replays, Math.floor(at)),
    last: (replays) => replays[0].replay.scene.steps - 1,
    start: (scene) => Math.floor(scene.steps / 2),
    rate: (scene) => scene.rate,
    clock: (scene, at) => `scan ${Math.floor(at) + 1}`,
    spoken: (replay, at) => `${replay.numbers[Math.floor(at)]} of ${replay.scene.numbers[Math.floor(at)]} targets reported, error ${ns.withUnit(replay.errors[Math.floor(at)], ns.sets.measure(replay.scene))}`,
    spokenTime: (scene, at) => `scan ${Math.floor(at) + 1}`,
    sentence: setsSentence,
  };

  ns.stages = { arm, sets, of: (scene) => (scene.form === "arm" ? arm : sets) };
})();

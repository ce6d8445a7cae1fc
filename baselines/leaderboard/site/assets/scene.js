// Pictures of an episode on three canvases: the floor from above, the camera's view, the tracking error.
(function () {
  "use strict";
  const ns = window.servotrack;
  // The floor's window in units of the arm's reach: most of what the tool can reach.
  const SIDE = 1.72, LEFT = -0.62, BOTTOM = -0.64;
  const TRAIL = 126; // samples of a trail
  const BANDS = 7;
  const DECADES = [-4, 0]; // 0.1 mm to 1 m
  const SUCCESS = 0.01; // m
  const TEXT = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif";

  let palette = null;
  function colors() {
    if (palette) return palette;
    palette = {};
    for (const name of ["floor", "floor-grid", "floor-lit", "floor-ink", "ivory", "ink", "link-fill", "target", "tool", "second", "third", "lens", "lens-grid", "lens-ink", "goal", "shadow", "plot", "plot-line", "plot-ink", "success"]) palette[name] = ns.color(name);
    return palette;
  }
  window.addEventListener("schemechange", () => { palette = null; backdrops.clear(); });

  // Context of a canvas in CSS pixels, resized to the screen's.
  function context(canvas) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return { pen, width, height, ratio };
  }

  function window_(links, width) {
    const reach = links[0] + links[1], scale = width / (SIDE * reach);
    return {
      reach, scale,
      to: ([x, y]) => [-LEFT * reach * scale + x * scale, width + BOTTOM * reach * scale - y * scale],
      from: ([u, v]) => [(u + LEFT * reach * scale) / scale, (width + BOTTOM * reach * scale - v) / scale],
    };
  }

  // Floor, grid and circle of reach: painted once per size and scheme.
  const backdrops = new Map();
  function backdrop(links, width, ratio) {
    const key = `${(links[0] + links[1]).toFixed(4)} ${width} ${ratio}`;
    if (backdrops.has(key)) return backdrops.get(key);
    if (backdrops.size > 8) backdrops.clear();
    const layer = document.createElement("canvas");
    layer.width = layer.height = Math.max(1, Math.round(width * ratio));
    const pen = layer.getContext("2d"), c = colors(), view = window_(links, width);
    pen.scale(ratio, ratio);
    pen.fillStyle = c.floor;
    pen.fillRect(0, 0, width, width);
    const farthest = Math.ceil((SIDE * view.reach) / 0.2);
    for (let k = -farthest; k <= farthest; k++) {
      const [u, v] = view.to([k * 0.2, k * 0.2]);
      pen.strokeStyle = c["floor-grid"];
      pen.lineWidth = k === 0 ? 1.6 : 1;
      pen.beginPath();
      pen.moveTo(u, 0);
      pen.lineTo(u, width);
      pen.moveTo(0, v);
      pen.lineTo(width, v);
      pen.stroke();
    }
    pen.strokeStyle = c["floor-ink"];
    pen.globalAlpha = 0.35;
    pen.setLineDash([3, 4]);
    pen.beginPath();
    pen.arc(...view.to([0, 0]), view.reach * view.scale, 0, 2 * Math.PI);
    pen.stroke();
    backdrops.set(key, layer);
    return layer;
  }

  function disc(pen, [x, y], radius, fill) {
    pen.fillStyle = fill;
    pen.beginPath();
    pen.arc(x, y, Math.max(radius, 0), 0, 2 * Math.PI);
    pen.fill();
  }

  // Polyline that fades with age; points are oldest first, pixels.
  function trail(pen, points, stroke, width = 2) {
    if (points.length < 2) return;
    pen.strokeStyle = stroke;
    pen.lineWidth = width;
    pen.lineJoin = pen.lineCap = "round";
    for (let band = 0; band < BANDS; band++) {
      const from = Math.max(0, points.length - Math.round((TRAIL * (BANDS - band)) / BANDS));
      const to = Math.min(points.length - 1, points.length - Math.round((TRAIL * (BANDS - band - 1)) / BANDS));
      if (to <= from) continue;
      pen.globalAlpha = 0.08 + 0.85 * Math.pow((band + 1) / BANDS, 1.6);
      pen.beginPath();
      points.slice(from, to + 1).forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  function tapered(pen, [x0, y0], [x1, y1], a, b) {
    const length = Math.max(Math.hypot(x1 - x0, y1 - y0), 1e-9), cx = (x1 - x0) / length, cy = (y1 - y0) / length;
    const turn = Math.atan2(cy, cx);
    pen.beginPath();
    pen.arc(x0, y0, a, turn + Math.PI / 2, turn - Math.PI / 2);
    pen.arc(x1, y1, b, turn - Math.PI / 2, turn + Math.PI / 2);
    pen.closePath();
  }

  function points(view, links, joints) {
    const elbow = [links[0] * Math.cos(joints[0]), links[0] * Math.sin(joints[0])];
    return [[0, 0], elbow, ns.arm.tool(links, joints)].map(view.to);
  }

  // An arm; a ghost is a translucent silhouette in its color.
  function arm(pen, view, links, joints, tint, ghost) {
    const size = view.scale * view.reach, c = colors();
    const [base, elbow, tool] = points(view, links, joints);
    if (ghost) {
      pen.globalAlpha = 0.3;
      pen.fillStyle = tint;
      pen.strokeStyle = tint;
      pen.lineJoin = pen.lineCap = "round";
      pen.lineWidth = 0.05 * size;
      pen.beginPath();
      pen.moveTo(...base);
      pen.lineTo(...elbow);
      pen.lineTo(...tool);
      pen.stroke();
      pen.globalAlpha = 1;
      disc(pen, tool, 0.033 * size, tint);
      disc(pen, tool, 0.019 * size, c.ivory);
      return;
    }
    // Two translucent strokes look like a soft shadow, at a tenth of the time of a blurred one.
    pen.save();
    pen.translate(4, 6);
    pen.strokeStyle = c.shadow;
    pen.lineCap = pen.lineJoin = "round";
    for (const width of [0.085, 0.055]) {
      pen.lineWidth = width * size;
      pen.beginPath();
      pen.moveTo(...base);
      pen.lineTo(...elbow);
      pen.lineTo(...tool);
      pen.stroke();
    }
    pen.restore();
    disc(pen, base, 0.08 * size, c["floor-ink"]);
    disc(pen, base, 0.08 * size - 1.4, c["floor-lit"]);
    for (const [from, to, a, b] of [[base, elbow, 0.042, 0.033], [elbow, tool, 0.033, 0.022]]) {
      pen.fillStyle = c["link-fill"];
      pen.strokeStyle = c.ink;
      pen.lineWidth = 1.4;
      tapered(pen, from, to, a * size, b * size);
      pen.fill();
      pen.stroke();
    }
    for (const [joint, radius] of [[base, 0.027], [elbow, 0.0215]]) {
      disc(pen, joint, radius * size, c.ink);
      disc(pen, joint, 0.5 * radius * size, c["link-fill"]);
    }
    pen.save();
    pen.translate(...tool);
    pen.rotate(-(joints[0] + joints[1]));
    pen.fillStyle = tint;
    const half = 0.04 * size;
    pen.beginPath();
    pen.roundRect(-half, -half, 2 * half, 2 * half, 0.25 * half);
    pen.fill();
    pen.restore();
    disc(pen, tool, 0.029 * size, c["link-fill"]);
    disc(pen, tool, 0.012 * size, tint);
  }

  // The floor from above. actors: [{joints, trail, tint, ghost}], the first one has the camera; trails in m.
  function floor(canvas, { scene, actors, target, targetTrail, pointer }) {
    const { pen, width, ratio } = context(canvas);
    if (!width) return;
    const view = window_(scene.links, width), c = colors(), size = view.scale * view.reach;
    pen.drawImage(backdrop(scene.links, width, ratio), 0, 0, width, width);
    const lead = actors.find((actor) => !actor.ghost);
    if (lead) {
      scene.outline ??= ns.camera.outline(scene.camera, scene.size);
      const at = ns.camera.pose(scene.camera, scene.links, lead.joints);
      pen.beginPath();
      scene.outline.forEach((corner, k) => {
        const [x, y] = view.to(ns.camera.onFloor(at, corner));
        if (k) pen.lineTo(x, y);
        else pen.moveTo(x, y);
      });
      pen.closePath();
      pen.fillStyle = lead.tint;
      pen.globalAlpha = 0.07;
      pen.fill();
      pen.globalAlpha = 0.45;
      pen.strokeStyle = lead.tint;
      pen.lineWidth = 1;
      pen.stroke();
      pen.globalAlpha = 1;
    }
    trail(pen, targetTrail.map(view.to), c.target, 2.2);
    for (const actor of actors) trail(pen, actor.trail.map(view.to), actor.tint, actor.ghost ? 1.6 : 2.2);
    for (const actor of [...actors].reverse()) arm(pen, view, scene.links, actor.joints, actor.tint, actor.ghost);
    const at = view.to(target);
    disc(pen, at, 0.021 * size + 1.6, c.ivory);
    disc(pen, at, 0.021 * size, c.target);
    if (pointer) {
      pen.strokeStyle = c.ink;
      pen.lineWidth = 1.2;
      pen.beginPath();
      const [x, y] = view.to(pointer);
      pen.arc(x, y, 11, 0, 2 * Math.PI);
      for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
        pen.moveTo(x + 8 * dx, y + 8 * dy);
        pen.lineTo(x + 14 * dx, y + 14 * dy);
      }
      pen.stroke();
    }
  }

  // The camera's view, drawn from the true geometry: no noise, no delay.
  function camera(canvas, { scene, joints, target, targetTrail, unseen }) {
    const { pen, width } = context(canvas);
    if (!width) return;
    const c = colors(), scale = width / scene.size;
    const at = ns.camera.pose(scene.camera, scene.links, joints);
    pen.fillStyle = c.lens;
    pen.fillRect(0, 0, width, width);
    pen.strokeStyle = c["lens-grid"];
    pen.lineWidth = 1;
    pen.beginPath();
    for (const line of ns.camera.lines(scene.camera, at, scene.size)) {
      line.forEach(([u, v], k) => (k ? pen.lineTo(u * scale, v * scale) : pen.moveTo(u * scale, v * scale)));
    }
    pen.stroke();
    trail(pen, targetTrail.filter(Boolean).map(([u, v]) => [u * scale, v * scale]), c.target, 1.6);
    const goal = scene.goal.map((value) => value * scale);
    const seen = ns.camera.project(scene.camera, at, ...target);
    pen.strokeStyle = c.goal;
    pen.lineWidth = 1.2;
    if (seen) {
      const spot = seen.map((value) => value * scale);
      pen.globalAlpha = 0.7;
      pen.beginPath();
      pen.moveTo(...goal);
      pen.lineTo(...spot);
      pen.stroke();
      pen.globalAlpha = 1;
      disc(pen, spot, 6.5, c.target);
      if (unseen) disc(pen, spot, 5, c.lens);
    }
    pen.beginPath();
    pen.arc(...goal, 10, 0, 2 * Math.PI);
    for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
      pen.moveTo(goal[0] + 10 * dx, goal[1] + 10 * dy);
      pen.lineTo(goal[0] + 17 * dx, goal[1] + 17 * dy);
    }
    pen.stroke();
    const inside = seen && seen.every((value) => value >= 0 && value < scene.size);
    if (unseen || !inside) {
      pen.fillStyle = c["lens-ink"];
      pen.font = `12px ${TEXT}`;
      pen.textAlign = "right";
      pen.fillText(inside ? "frame lost" : "out of view", width - 10, 18);
      pen.textAlign = "left";
    }
  }

  // Tracking errors on a logarithmic axis. series: [{errors, tint, until}]; now: sample of the cursor.
  function errors(canvas, { scene, series, now, steps }) {
    const { pen, width, height } = context(canvas);
    if (!width) return;
    const c = colors(), left = 54, right = 8, top = 8, bottom = 20;
    const x = (k) => left + ((width - left - right) * k) / steps;
    const y = (error) => {
      const decade = Math.log10(Math.min(Math.max(error, 10 ** DECADES[0]), 10 ** DECADES[1]));
      return top + ((height - top - bottom) * (DECADES[1] - decade)) / (DECADES[1] - DECADES[0]);
    };
    pen.fillStyle = c.plot;
    pen.fillRect(0, 0, width, height);
    pen.fillStyle = c.success;
    pen.fillRect(left, y(SUCCESS), width - left - right, y(1e-4) - y(SUCCESS));
    pen.font = `11px ${TEXT}`;
    pen.fillStyle = c["plot-ink"];
    pen.strokeStyle = c["plot-line"];
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const [value, label] of [[1, "1 m"], [0.1, "10 cm"], [0.01, "1 cm"], [0.001, "1 mm"], [0.0001, "0.1 mm"]]) {
      const level = Math.round(y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(left, level);
      pen.lineTo(width - right, level);
      pen.stroke();
      if (height > 110 || [1, 0.01, 0.0001].includes(value)) pen.fillText(label, left - 6, level);
    }
    pen.textAlign = "center";
    pen.textBaseline = "alphabetic";
    const seconds = (steps - scene.warmup) * ns.arm.PERIOD, tick = width < 420 ? 4 : 2;
    for (let t = 0; t <= seconds + 1e-9; t += tick) pen.fillText(`${t} s`, Math.min(x(scene.warmup + t / ns.arm.PERIOD), width - right - 8), height - 5);
    pen.save();
    pen.beginPath();
    pen.rect(left, 0, width - left, height);
    pen.clip();
    for (const { errors: values, tint, until } of series) {
      for (const [from, to, alpha] of [[0, Math.min(until ?? now, values.length - 1), 1], [Math.min(until ?? now, values.length - 1), values.length - 1, 0.28]]) {
        if (to <= from) continue;
        pen.globalAlpha = alpha;
        pen.strokeStyle = tint;
        pen.lineWidth = 1.5;
        pen.lineJoin = "round";
        pen.beginPath();
        for (let k = Math.floor(from); k <= to; k++) {
          if (k === Math.floor(from)) pen.moveTo(x(k), y(values[k]));
          else pen.lineTo(x(k), y(values[k]));
        }
        pen.stroke();
      }
      pen.globalAlpha = 1;
      const at = Math.min(now, values.length - 1);
      if (values.length) disc(pen, [x(at), y(between(values, at))], 3.5, tint);
    }
    pen.restore();
    pen.strokeStyle = c["plot-ink"];
    pen.globalAlpha = 0.5;
    pen.beginPath();
    pen.moveTo(x(now), top);
    pen.lineTo(x(now), height - bottom);
    pen.stroke();
    pen.globalAlpha = 1;
  }

  // Value between two samples.
  function between(values, at) {
    const k = Math.min(Math.floor(at), values.length - 1), next = Math.min(k + 1, values.length - 1);
    return values[k] + (at - k) * (values[next] - values[k]);
  }

  ns.scene = { floor, camera, errors, between, window: window_, colors, context, TRAIL };
})();

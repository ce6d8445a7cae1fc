// Sets of targets: tracks, measurements and errors from the page's data, and their pictures.
(function () {
  "use strict";
  const ns = window.servotrack;
  const TRAIL = 25; // scans
  const LATE = 1.5; // s of measurements that still show
  const TEXT = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif";

  const measure = (scene) => ({ factor: 1, digits: scene.cutoff > 10 ? 1 : 2, unit: scene.unit });

  // Runs of consecutive scans: {id, first, points}. A point has one coordinate per curve.
  function runs([listed, numbers], found) {
    let at = 0;
    return listed.map(([id, first, length]) => {
      const points = Array.from({ length }, (_, k) => numbers.map((number) => found[number][at + k]));
      at += length;
      return { id, first, points };
    });
  }

  function numbersOf(list, steps) {
    const counted = new Array(steps).fill(0);
    for (const { first, points } of list) for (let k = 0; k < points.length; k++) if (first + k < steps) counted[first + k] += 1;
    return counted;
  }

  // Shares from [0, 1) of NumPy's PCG64 (O'Neill 2014), from its state before the first draw.
  function shares(state, increment) {
    const FACTOR = 0x2360ed051fc65da44385df649fccf645n;
    let now = state;
    return () => {
      now = BigInt.asUintN(128, now * FACTOR + increment);
      const word = (now >> 64n) ^ BigInt.asUintN(64, now), turn = now >> 122n;
      return Number(BigInt.asUintN(64, (word >> turn) | (word << (-turn & 63n))) >> 11n) / 9007199254740992;
    };
  }

  // False measurements of all scans, the numbers that the environment drew.
  function clutterOf({ state, increment, drawn, counts, low, high, sensor }) {
    const draw = shares(BigInt(`0x${state}`), BigInt(`0x${increment}`));
    return counts.map((count) => {
      const points = Array.from({ length: drawn }, () => low.map((least, axis) => least + (high[axis] - least) * draw())).slice(0, count);
      return sensor ? points.map(([range, bearing]) => [sensor[0] + range * Math.cos(bearing), sensor[1] + range * Math.sin(bearing)]) : points;
    });
  }

  // Measurements of all scans: those of the true targets and false ones, or one list for each scan.
  function scansOf(scene, truth, found) {
    if (scene.clutter) {
      const scans = clutterOf(scene.clutter), [missed, ...offsets] = scene.seen.map((number) => found[number]);
      let state = 0, seen = 0;
      for (const { first, points } of truth) points.forEach((point, k) => {
        if (missed[state++]) return;
        scans[first + k].push(point.map((value, axis) => value + offsets[axis][seen]));
        seen++;
      });
      return scans;
    }
    const [counts, numbers] = scene.scans ?? [[], []];
    let at = 0;
    return counts.map((count) => {
      const scan = Array.from({ length: count }, (_, k) => numbers.map((number) => found[number][at + k]));
      at += count;
      return scan;
    });
  }

  function unpackScene(scene, found) {
    const truth = runs(scene.truth, found);
    let scans = null;
    return {
      ...scene, truth, numbers: numbersOf(truth, scene.steps), measured: Boolean(scene.clutter ?? scene.scans), alone: scene.form === "boxes" && new Set(truth.map((run) => run.id)).size === 1,
      // Drawn when the scene is first shown.
      get scans() { return (scans ??= scansOf(scene, truth, found)); },
    };
  }

  function unpackReplay(replay, scene, found) {
    // Answers without tracks are the measurements.
    let list = null, numbers = null;
    return {
      ...replay, scene, errors: found[replay.errors], length: scene.steps,
      get runs() { return (list ??= replay.tracks ? runs(replay.tracks, found) : scene.scans.flatMap((scan, k) => scan.map((point, id) => ({ id, first: k, points: [point] })))); },
      get numbers() { return (numbers ??= numbersOf(this.runs, scene.steps)); },
    };
  }

  // Map from the scene to the canvas. Images have their origin at the top, floors at the bottom.
  function view(scene, width, height) {
    const [x0, y0, x1, y1] = scene.window;
    if (scene.form === "bearings") {
      const [low, high] = [x0, x1];
      return { place: ([bearing], k) => [(width * (bearing - low)) / (high - low), (height * (k + 0.5)) / scene.steps] };
    }
    const flip = scene.form === "points";
    return { place: ([x, y]) => [(width * (x - x0)) / (x1 - x0), (height * (flip ? y1 - y : y - y0)) / (y1 - y0)], scale: width / (x1 - x0) };
  }

  // Colors of identities: hues that differ from neighbors, of the scheme's lightness.
  const identity = (id) => `hsl(${(id * 137.5 + 200) % 360} 62% ${ns.scheme.get() === "dark" ? 68 : 38}%)`;

  function polyline(pen, points) {
    pen.beginPath();
    points.forEach(([u, v], k) => (k ? pen.lineTo(u, v) : pen.moveTo(u, v)));
    pen.stroke();
  }

  const outline = (pen, at, [x, y, w, h]) => {
    const [u, v] = at.place([x, y]);
    pen.strokeRect(u, v, w * at.scale, h * at.scale);
  };
  // Center of a box; a point is its own.
  const center = (scene, point) => (scene.form === "boxes" ? [point[0] + point[2] / 2, point[1] + point[3] / 2] : point);

  // Trail of a run up to scan `now`, and its newest point if it exists then.
  function drawRun(pen, at, scene, run, now, width, mark) {
    const last = now - run.first, from = scene.form === "bearings" ? 0 : Math.max(0, last - TRAIL);
    if (last < 0 || from >= run.points.length) return;
    const shown = run.points.slice(from, last + 1).map((point, k) => at.place(center(scene, point), run.first + from + k));
    pen.lineWidth = width;
    polyline(pen, shown);
    if (last < run.points.length) mark(run.points[last], shown[shown.length - 1]);
  }

  function drawMap(canvas, scene, replays, now) {
    const { pen, width, height, ratio } = ns.scene.context(canvas);
    if (!width) return;
    const c = ns.scene.colors(), at = view(scene, width, height), shared = replays.length > 1;
    pen.fillStyle = c.floor;
    pen.fillRect(0, 0, width, height);
    pen.strokeStyle = c["floor-grid"];
    pen.lineWidth = 1;
    for (let k = 1; k < 10; k++) polyline(pen, [[(k * width) / 10, 0], [(k * width) / 10, height]]), polyline(pen, [[0, (k * height) / 10], [width, (k * height) / 10]]);
    pen.lineJoin = pen.lineCap = "round";
    // Measurements of the last scans fade.
    const late = Math.max(1, Math.round(LATE * Math.min(scene.rate, 4)));
    pen.strokeStyle = c["floor-ink"];
    pen.lineWidth = 1.1;
    for (let k = Math.max(0, now - late + 1); k <= now; k++) {
      pen.globalAlpha = k === now ? 0.95 : 0.14;
      pen.beginPath();
      for (const point of scene.scans[k] ?? []) {
        const [u, v] = at.place(point, k);
        pen.moveTo(u - 2.5, v - 2.5); pen.lineTo(u + 2.5, v + 2.5); pen.moveTo(u - 2.5, v + 2.5); pen.lineTo(u + 2.5, v - 2.5);
      }
      pen.stroke();
    }
    pen.globalAlpha = 1;
    for (const run of scene.truth) {
      pen.strokeStyle = c.target;
      pen.globalAlpha = 0.55;
      drawRun(pen, at, scene, run, now, scene.form === "bearings" ? 4 : 2, (point, [u, v]) => {
        pen.globalAlpha = 1;
        pen.fillStyle = c.target;
        if (scene.form === "boxes") { pen.lineWidth = 2.4; outline(pen, at, point); return; }
        pen.beginPath();
        pen.arc(u, v, 3.6, 0, 2 * Math.PI);
        pen.fill();
      });
      pen.globalAlpha = 1;
    }
    replays.slice().reverse().forEach(({ replay, tint }, k) => {
      const lead = k === replays.length - 1;
      for (const run of replay.runs) {
        pen.strokeStyle = shared ? tint : identity(run.id);
        pen.setLineDash(lead ? [] : [5, 3]);
        drawRun(pen, at, scene, run, now, 1.5, (point, [u, v]) => {
          pen.lineWidth = 2;
          if (scene.form === "boxes") { outline(pen, at, point); return; }
          pen.beginPath();
          if (lead) pen.arc(u, v, 8, 0, 2 * Math.PI);
          else pen.rect(u - 9.5, v - 9.5, 19, 19);
          pen.stroke();
        });
      }
      pen.setLineDash([]);
    });
    if (scene.form === "bearings") {
      pen.strokeStyle = c["plot-ink"];
      pen.lineWidth = 1;
      polyline(pen, [[0, (height * (now + 1)) / scene.steps], [width, (height * (now + 1)) / scene.steps]]);
    }
    scaleBar(pen, scene, width, height, c, ratio);
  }

  // A length of the scene in the corner of the picture.
  function scaleBar(pen, scene, width, height, c) {
    if (scene.form === "boxes") return;
    const [x0, , x1] = scene.window, length = ns.plots.ticks(0, x1 - x0, 6)[1], bar = (length * width) / (x1 - x0);
    pen.strokeStyle = pen.fillStyle = c["plot-ink"];
    pen.lineWidth = 2;
    polyline(pen, [[10, height - 10], [10 + bar, height - 10]]);
    pen.font = `11px ${TEXT}`;
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    pen.fillText(`${length} ${scene.unit}`, 10, height - 15);
  }

  // A strip over all scans: numbers on its left side, a cursor, and what `draw` adds with its scales.
  function plot(canvas, steps, now, high, marks, draw) {
    const { pen, width, height } = ns.scene.context(canvas);
    if (!width) return;
    const c = ns.scene.colors(), left = 34, right = 8, top = 8, bottom = 20;
    const x = ns.plots.linear(0, steps, left, width - right), y = ns.plots.linear(0, high, height - bottom, top);
    pen.fillStyle = c.plot;
    pen.fillRect(0, 0, width, height);
    pen.font = `11px ${TEXT}`;
    pen.lineWidth = 1;
    for (const mark of marks) {
      pen.strokeStyle = c["plot-line"];
      polyline(pen, [[left, Math.round(y(mark)) + 0.5], [width - right, Math.round(y(mark)) + 0.5]]);
      pen.fillStyle = c["plot-ink"];
      pen.textAlign = "right";
      pen.textBaseline = "middle";
      pen.fillText(String(Number(mark.toPrecision(3))), left - 5, y(mark));
    }
    pen.textAlign = "center";
    pen.textBaseline = "alphabetic";
    for (const mark of ns.plots.ticks(0, steps, width < 300 ? 3 : 5)) pen.fillText(String(mark), Math.min(x(mark), width - right - 8), height - 5);
    draw(pen, x, y, c);
    pen.strokeStyle = c["plot-ink"];
    pen.globalAlpha = 0.5;
    polyline(pen, [[x(now + 0.5), top], [x(now + 0.5), height - bottom]]);
    pen.globalAlpha = 1;
  }

  // Steps of a histogram line.
  const stairs = (values, x, y) => Array.from(values).flatMap((value, k) => [[x(k), y(value)], [x(k + 1), y(value)]]);

  function drawStrips(canvases, scene, replays, now) {
    const most = Math.max(2, ...scene.numbers, ...replays.flatMap(({ replay }) => replay.numbers));
    plot(canvases.counts, scene.steps, now, 1.08 * most, ns.plots.ticks(0, most, 3), (pen, x, y, c) => {
      pen.fillStyle = c.target;
      pen.globalAlpha = 0.28;
      pen.beginPath();
      [[x(0), y(0)], ...stairs(scene.numbers, x, y), [x(scene.steps), y(0)]].forEach(([u, v], k) => (k ? pen.lineTo(u, v) : pen.moveTo(u, v)));
      pen.fill();
      pen.globalAlpha = 1;
      pen.lineWidth = 1.5;
      for (const { replay, tint } of replays.slice().reverse()) { pen.strokeStyle = tint; polyline(pen, stairs(replay.numbers, x, y)); }
    });
    plot(canvases.errors, scene.steps, now, 1.02 * scene.cutoff, ns.plots.ticks(0, scene.cutoff, 4), (pen, x, y) => {
      pen.lineWidth = 1.5;
      for (const { replay, tint } of replays.slice().reverse()) { pen.strokeStyle = tint; polyline(pen, stairs(replay.errors, x, y)); }
    });
  }

  // Show a scan of episodes that share a scene. replays: [{replay, tint}], the first one leads.
  function show(canvases, replays, now) {
    const { scene } = replays[0].replay;
    drawMap(canvases.map, scene, replays, now);
    drawStrips(canvases, scene, replays, now);
  }

  ns.sets = { unpackScene, unpackReplay, show, measure, clutterOf };
})();

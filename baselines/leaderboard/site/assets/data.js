// Data of the page: scripts in data/ hand their documents to `deliver`, which also works from file://.
(function () {
  "use strict";
  const ns = window.servotrack;
  const documents = new Map();
  const waiting = new Map();
  const decoded = new Map();

  async function inflate(text) {
    const bytes = Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // The text is compressed JSON in Base64.
  ns.deliver = (name, text) => {
    const content = inflate(text).then((bytes) => JSON.parse(new TextDecoder().decode(bytes)));
    documents.set(name, content);
    waiting.get(name)?.(content);
    waiting.delete(name);
  };

  // The document of data/NAME.js, loaded once.
  function load(name) {
    if (documents.has(name)) return documents.get(name);
    if (!/^[a-z0-9-]+$/.test(name)) return Promise.reject(new Error(`no such data: ${name}`));
    return new Promise((resolve, reject) => {
      waiting.set(name, resolve);
      const script = document.createElement("script");
      script.src = `data/${name}.js`;
      script.onerror = () => {
        waiting.delete(name);
        reject(new Error(`data/${name}.js is missing beside this page`));
      };
      document.head.append(script);
    });
  }

  // Curves of a document: differences of some order, zigzag, low bytes before high ones.
  async function curves(content) {
    const planes = await inflate(content.samples);
    const total = planes.length / 2;
    let at = 0;
    return content.curves.map(([first, length, step, order]) => {
      const values = new Float64Array(length), sums = new Array(order).fill(0);
      for (let k = 0; k < length; k++, at++) {
        const word = planes[at] | (planes[total + at] << 8);
        let value = (word >>> 1) ^ -(word & 1);
        for (let n = 0; n < order; n++) value = sums[n] += value;
        values[k] = (first + value) * step;
      }
      return values;
    });
  }

  // Scenes and replays of a document with their curves.
  async function unpack(content) {
    const found = await curves(content);
    const scenes = new Map();
    for (const [seed, scene] of Object.entries(content.scenes)) {
      if (scene.form !== "arm") { scenes.set(Number(seed), ns.sets.unpackScene({ ...scene, seed: Number(seed) }, found)); continue; }
      scenes.set(Number(seed), {
        ...scene,
        seed: Number(seed),
        path: scene.path.map((number) => found[number]),
        noise: scene.noise ? scene.noise.map((number) => found[number]) : null,
      });
    }
    const replays = content.replays.map((replay) => {
      const scene = scenes.get(replay.seed);
      if (scene.form !== "arm") return ns.sets.unpackReplay(replay, scene, found);
      const joints = replay.joints.map((number) => found[number]);
      const length = joints[0].length;
      const errors = new Float64Array(length);
      for (let k = 0; k < length; k++) {
        const [x, y] = ns.arm.tool(scene.links, [joints[0][k], joints[1][k]]);
        errors[k] = Math.hypot(x - scene.path[0][k], y - scene.path[1][k]);
      }
      return { ...replay, joints, scene, errors, length };
    });
    return { ...content, scenes, replays };
  }

  // An unpacked document.
  function unpacked(name) {
    if (!decoded.has(name)) decoded.set(name, load(name).then(unpack));
    return decoded.get(name);
  }

  let board = null;
  const ready = async () => (board = await documents.get("board"));

  ns.data = { load, unpack, unpacked, ready, board: () => board };
})();

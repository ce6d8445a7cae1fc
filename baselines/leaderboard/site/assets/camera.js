// Camera over the floor: the model of estimators/camera.py, and what of the floor it sees (envs/servo/footprint.py).
(function () {
  "use strict";
  const ns = window.servotrack;
  const BORDER = 12;
  const GRID = 0.2; // m

  // Pose of the camera's frame on the floor: tool position, cosine and sine of the direction of its x axis.
  function pose(camera, links, joints) {
    const phi = joints[0] + joints[1];
    const c2 = Math.cos(phi), s2 = Math.sin(phi);
    return {
      x: links[0] * Math.cos(joints[0]) + links[1] * c2,
      y: links[0] * Math.sin(joints[0]) + links[1] * s2,
      c: c2 * camera[5] - s2 * camera[6],
      s: s2 * camera[5] + c2 * camera[6],
    };
  }

  // Pixel of a point of the floor; null if it lies behind the camera or beyond the fold of the lens.
  function project(camera, at, px, py) {
    const wx = px - at.x, wy = py - at.y;
    const gx = at.c * wx + at.s * wy, gy = at.s * wx - at.c * wy, d = camera[4];
    const qx = camera[7] * gx + camera[8] * gy + camera[9] * d;
    const qy = camera[10] * gx + camera[11] * gy + camera[12] * d;
    const qz = camera[13] * gx + camera[14] * gy + camera[15] * d;
    if (qz < 1e-6 * d) return null;
    const du = (camera[0] * qx) / qz, dv = (camera[1] * qy) / qz;
    const rho2 = (du * du + dv * dv) * camera[17] * camera[17];
    if (1 + 3 * camera[16] * rho2 <= 0) return null;
    const stretch = 1 + camera[16] * rho2;
    return [camera[2] + du * stretch, camera[3] + dv * stretch];
  }

  // Point of the floor behind a pixel, in the camera's frame.
  function ground(camera, u, v) {
    const du = u - camera[2], dv = v - camera[3], k = camera[16];
    const distorted = Math.hypot(du, dv) * camera[17];
    const fold = k < 0 ? 0.999 * Math.sqrt(-1 / (3 * k)) : Infinity;
    let rho = Math.min(distorted, fold);
    for (let pass = 0; pass < 8; pass++) {
      const step = (rho * (1 + k * rho * rho) - distorted) / (1 + 3 * k * rho * rho);
      if (step === 0) break;
      rho = Math.min(rho - step, fold);
    }
    const scale = distorted > 1e-12 ? rho / distorted : 1;
    const x = (du * scale) / camera[0], y = (dv * scale) / camera[1];
    const rx = camera[7] * x + camera[10] * y + camera[13];
    const ry = camera[8] * x + camera[11] * y + camera[14];
    const rz = Math.max(camera[9] * x + camera[12] * y + camera[15], 1e-3);
    return [(rx * camera[4]) / rz, (ry * camera[4]) / rz];
  }

  // Outline of the floor in view, in the camera's frame. It is constant during an episode.
  function outline(camera, size) {
    const far = 10 * camera[4], corners = [];
    for (let side = 0; side < 4; side++) {
      for (let k = 0; k < BORDER; k++) {
        const along = (k / BORDER) * size;
        const [u, v] = [[along, 0], [size, along], [size - along, size], [0, size - along]][side];
        const [gx, gy] = ground(camera, u, v);
        const shrink = Math.min(1, far / Math.max(Math.hypot(gx, gy), 1e-9));
        corners.push([gx * shrink, gy * shrink]);
      }
    }
    return corners;
  }

  const onFloor = (at, [gx, gy]) => [at.x + at.c * gx + at.s * gy, at.y + at.s * gx - at.c * gy];

  // Grid lines of the floor in the image: arrays of pixels.
  function lines(camera, at, size) {
    const reach = Math.min(Math.max((2.6 * size * camera[4]) / camera[0], 0.4), 4);
    const spacing = reach <= 1.6 ? GRID : 2 * GRID;
    const each = Math.ceil(reach / spacing), half = each * spacing, samples = camera[16] ? 25 : 13;
    const cx = Math.round(at.x / spacing) * spacing, cy = Math.round(at.y / spacing) * spacing;
    const found = [];
    for (let axis = 0; axis < 2; axis++) {
      for (let k = -each; k <= each; k++) {
        const line = [];
        let near = false;
        for (let j = 0; j < samples; j++) {
          const along = -half + (2 * half * j) / (samples - 1);
          const pixel = axis ? project(camera, at, cx + along, cy + k * spacing) : project(camera, at, cx + k * spacing, cy + along);
          if (!pixel || pixel[0] <= -size || pixel[0] >= 2 * size || pixel[1] <= -size || pixel[1] >= 2 * size) continue;
          line.push(pixel);
          near ||= Math.abs(pixel[0] / size - 0.5) < 1 && Math.abs(pixel[1] / size - 0.5) < 1;
        }
        if (near && line.length > 1) found.push(line);
      }
    }
    return found;
  }

  ns.camera = { pose, project, outline, onFloor, lines };
})();

// The planar arm of UncalibServo, simulated as the package's compiled engine does it: Chipmunk's solver written out for
// two rods, the same operations in the same order (envs/servo/compiled_arms.py, sensing.py). Sines and cosines are the
// browser's own, which is the only difference. Plain script: no imports, so that it also runs in Node and from file://.
(function (root) {
  "use strict";
  const ns = (root.servotrack = root.servotrack || {});

  const PERIOD = 0.05; // s, control period
  const LOW = [-Math.PI / 2, 0.0]; // rad, joint stops
  const HIGH = [Math.PI / 2, Math.PI];
  const START = [0.0, Math.PI / 2];
  const LINK_MASS = 1.0; // kg
  const CAMERA_MASS = 0.2;
  const LOWER_MASS = LINK_MASS + CAMERA_MASS;
  const PIVOT_BIAS = Math.pow(0.01, 60);
  // Chipmunk subtracts in single precision.
  const STOP_BIAS = Math.pow(Math.fround(1 - Math.fround(0.1)), 60);
  const DEFAULTS = { max_joint_rate: 2.0, max_motor_torque: 60.0, substeps: 5, solver_iterations: 20 };

  const excess = (angle, low, high) => (angle > high ? high - angle : angle < low ? low - angle : 0.0);

  function stopped(impulse, bias) {
    if (bias === 0.0) return 0.0;
    return bias < 0.0 ? Math.max(impulse, 0.0) : Math.min(impulse, 0.0);
  }

  class Arm {
    // links: two lengths, m; settings: fields of ServoConfig that differ from the defaults; gain: factors on the rates.
    constructor(links, settings = {}, gain = [1.0, 1.0]) {
      const given = { ...DEFAULTS, ...settings };
      const [l1, l2] = links;
      this.links = [l1, l2];
      this.gain = gain;
      this.maxRate = given.max_joint_rate;
      this.substeps = given.substeps;
      this.iterations = given.solver_iterations;
      this.dt = PERIOD / given.substeps;
      this.limit = given.max_motor_torque * this.dt;
      this.pivot = 1.0 - Math.pow(PIVOT_BIAS, this.dt);
      this.stop = 1.0 - Math.pow(STOP_BIAS, this.dt);

      const center = ((LINK_MASS * l2) / 2 + CAMERA_MASS * l2) / LOWER_MASS;
      const fromMiddle = center - l2 / 2;
      const fromCamera = l2 - center;
      const moment1 = (LINK_MASS * l1 * l1) / 12;
      const moment2 = LINK_MASS * ((l2 * l2) / 12 + fromMiddle * fromMiddle) + CAMERA_MASS * (fromCamera * fromCamera);
      const angle1 = START[0];
      const angle2 = START[0] + START[1];
      const c1 = Math.cos(angle1), s1 = Math.sin(angle1), c2 = Math.cos(angle2), s2 = Math.sin(angle2);
      this.m1 = 1.0 / LINK_MASS;
      this.m2 = 1.0 / LOWER_MASS;
      this.i1 = 1.0 / moment1;
      this.i2 = 1.0 / moment2;
      this.half = l1 / 2;
      this.center = center;
      this.felt1 = 1.0 / this.i1;
      this.felt2 = 1.0 / (this.i1 + this.i2);
      this.x1 = (l1 / 2) * c1;
      this.y1 = (l1 / 2) * s1;
      this.a1 = angle1;
      this.x2 = l1 * c1 + center * c2;
      this.y2 = l1 * s1 + center * s2;
      this.a2 = angle2;
      this.vx1 = this.vy1 = this.w1 = this.vx2 = this.vy2 = this.w2 = 0.0;
      this.motor1 = this.motor2 = this.stop1 = this.stop2 = 0.0;
      this.px1 = this.py1 = this.px2 = this.py2 = 0.0;
      this.rates = [0.0, 0.0];
      this.joints = [START[0], START[1]];
    }

    // Advance by one control period. action: fractions of the largest joint rate; noise: added to the rates, rad/s.
    step(action, noise = null) {
      for (let j = 0; j < 2; j++) {
        let rate = Math.min(Math.max(action[j], -1.0), 1.0) * this.maxRate * this.gain[j];
        if (noise) rate += noise[j];
        const coasted = this.joints[j] + this.dt * this.rates[j];
        this.rates[j] = Math.min(Math.max(rate, (LOW[j] - coasted) / PERIOD), (HIGH[j] - coasted) / PERIOD);
      }
      for (let substep = 0; substep < this.substeps; substep++) {
        this.prepare();
        for (let k = 0; k < this.iterations; k++) this.iterate();
      }
      this.joints = [this.a1, this.a2 - this.a1];
      return this.joints;
    }

    tool() {
      return tool(this.links, this.joints);
    }

    prepare() {
      const dt = this.dt, { m1, i1, m2, i2 } = this;
      this.x1 += this.vx1 * dt;
      this.y1 += this.vy1 * dt;
      this.a1 += this.w1 * dt;
      this.x2 += this.vx2 * dt;
      this.y2 += this.vy2 * dt;
      this.a2 += this.w2 * dt;
      const c1 = Math.cos(this.a1), s1 = Math.sin(this.a1), c2 = Math.cos(this.a2), s2 = Math.sin(this.a2);
      const pull = -this.pivot / dt;
      this.bias1 = (-this.stop * excess(this.a1, LOW[0], HIGH[0])) / dt;
      this.bias2 = (-this.stop * excess(this.a2 - this.a1, LOW[1], HIGH[1])) / dt;
      if (this.bias1 === 0.0) this.stop1 = 0.0;
      if (this.bias2 === 0.0) this.stop2 = 0.0;

      const rx = c1 * -this.half, ry = s1 * -this.half;
      let k11 = m1 + ry * ry * i1, k12 = -rx * ry * i1 + 0.0, k22 = m1 + rx * rx * i1;
      let scale = 1.0 / (k11 * k22 - k12 * k12);
      this.k11 = k22 * scale;
      this.k12 = -k12 * scale;
      this.k22 = k11 * scale;
      this.bx1 = (this.x1 + rx) * pull;
      this.by1 = (this.y1 + ry) * pull;

      const ux = c1 * this.half, uy = s1 * this.half;
      const qx = c2 * -this.center, qy = s2 * -this.center;
      k11 = m1 + m2 + uy * uy * i1;
      k12 = -ux * uy * i1 + 0.0;
      k22 = m1 + m2 + ux * ux * i1;
      k11 = k11 + qy * qy * i2;
      k12 = k12 + -qx * qy * i2;
      k22 = k22 + qx * qx * i2;
      scale = 1.0 / (k11 * k22 - k12 * k12);
      this.l11 = k22 * scale;
      this.l12 = -k12 * scale;
      this.l22 = k11 * scale;
      this.bx2 = (this.x2 + qx - (this.x1 + ux)) * pull;
      this.by2 = (this.y2 + qy - (this.y1 + uy)) * pull;
      Object.assign(this, { rx, ry, ux, uy, qx, qy });

      let w1 = this.w1 + this.motor1 * i1, w2 = this.w2;
      let j = this.motor2;
      w1 = w1 - j * i1;
      w2 = w2 + j * i2;
      w1 += this.stop1 * i1;
      w1 = w1 - this.stop2 * i1;
      w2 = w2 + this.stop2 * i2;
      let jx = this.px1, jy = this.py1;
      const vx1 = this.vx1 + jx * m1, vy1 = this.vy1 + jy * m1;
      w1 = w1 + i1 * (rx * jy - ry * jx);
      jx = this.px2;
      jy = this.py2;
      this.vx1 = vx1 - jx * m1;
      this.vy1 = vy1 - jy * m1;
      this.w1 = w1 + i1 * (ux * -jy - uy * -jx);
      this.vx2 += jx * m2;
      this.vy2 += jy * m2;
      this.w2 = w2 + i2 * (qx * jy - qy * jx);
    }

    iterate() {
      const { m1, i1, m2, i2, felt1, felt2, limit, rx, ry, ux, uy, qx, qy, bias1, bias2 } = this;
      let { vx1, vy1, w1, vx2, vy2, w2 } = this;
      // Motors turn the second body against the sign of their rate.
      let old = this.motor1;
      let now = Math.min(Math.max(old - (w1 + -this.rates[0]) * felt1, -limit), limit);
      this.motor1 = now;
      w1 += (now - old) * i1;
      old = this.motor2;
      now = Math.min(Math.max(old - (w2 - w1 + -this.rates[1]) * felt2, -limit), limit);
      this.motor2 = now;
      w1 = w1 - (now - old) * i1;
      w2 = w2 + (now - old) * i2;
      // Stops
      old = this.stop1;
      now = stopped(old - (bias1 + w1) * felt1, bias1);
      this.stop1 = now;
      w1 += (now - old) * i1;
      old = this.stop2;
      now = stopped(old - (bias2 + (w2 - w1)) * felt2, bias2);
      this.stop2 = now;
      w1 = w1 - (now - old) * i1;
      w2 = w2 + (now - old) * i2;
      // Shoulder
      let tx = this.bx1 - (vx1 + -ry * w1), ty = this.by1 - (vy1 + rx * w1);
      let ox = this.px1, oy = this.py1;
      let px = ox + (tx * this.k11 + ty * this.k12), py = oy + (tx * this.k12 + ty * this.k22);
      this.px1 = px;
      this.py1 = py;
      let jx = px - ox, jy = py - oy;
      vx1 = vx1 + jx * m1;
      vy1 = vy1 + jy * m1;
      w1 = w1 + i1 * (rx * jy - ry * jx);
      // Elbow
      tx = this.bx2 - (vx2 + -qy * w2 - (vx1 + -uy * w1));
      ty = this.by2 - (vy2 + qx * w2 - (vy1 + ux * w1));
      ox = this.px2;
      oy = this.py2;
      px = ox + (tx * this.l11 + ty * this.l12);
      py = oy + (tx * this.l12 + ty * this.l22);
      this.px2 = px;
      this.py2 = py;
      jx = px - ox;
      jy = py - oy;
      this.vx1 = vx1 + -jx * m1;
      this.vy1 = vy1 + -jy * m1;
      this.w1 = w1 + i1 * (ux * -jy - uy * -jx);
      this.vx2 = vx2 + jx * m2;
      this.vy2 = vy2 + jy * m2;
      this.w2 = w2 + i2 * (qx * jy - qy * jx);
    }
  }

  // Tool position in the base frame, m.
  function tool(links, joints) {
    const [first, second] = joints;
    return [
      links[0] * Math.cos(first) + links[1] * Math.cos(first + second),
      links[0] * Math.sin(first) + links[1] * Math.sin(first + second),
    ];
  }

  // Largest differences between this arm and recorded episodes: angles, tool and tracking error. Used by the tests.
  function compare(cases) {
    return cases.map((recorded) => {
      const arm = new Arm(recorded.links, recorded.settings, recorded.gain);
      const worst = { name: recorded.name, steps: recorded.actions.length, joints: 0, tool: 0, error: 0 };
      recorded.actions.forEach((action, k) => {
        arm.step(action, recorded.noise ? recorded.noise[k] : null);
        const at = arm.tool();
        const error = Math.hypot(at[0] - recorded.target[k][0], at[1] - recorded.target[k][1]);
        for (let j = 0; j < 2; j++) {
          worst.joints = Math.max(worst.joints, Math.abs(arm.joints[j] - recorded.joints[k][j]));
          worst.tool = Math.max(worst.tool, Math.abs(at[j] - recorded.tool[k][j]));
        }
        worst.error = Math.max(worst.error, Math.abs(error - recorded.error[k]));
      });
      return worst;
    });
  }

  ns.arm = { Arm, PERIOD, LOW, HIGH, START, tool, compare };
})(typeof window === "undefined" ? globalThis : window);

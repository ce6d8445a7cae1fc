// Agent of the public board in JavaScript: Broyden's rule learns how the image moves with the joints.
//
// servotrack submit --command "node agent.js" --name my-agent

const GAIN = 4.0, PROBING = 6, LEAST_MOVE = 0.03, TRUST = 0.3;
let memory = null, maxJointRate = 2.0;

function begin(seen) {
  return { J: [[0, 0], [0, 0]], step: 0, q: seen.joint_angles, f: seen.features };
}

// Update the Jacobian (px/rad) by the move since the last update.
function learn(seen) {
  const { J } = memory, q = seen.joint_angles, f = seen.features;
  const dq = [q[0] - memory.q[0], q[1] - memory.q[1]];
  const size = dq[0] * dq[0] + dq[1] * dq[1];
  if (size < LEAST_MOVE * LEAST_MOVE) return;
  // The first moves, of single joints, are believed. Later ones also hold the target's motion.
  const share = memory.step <= PROBING + 1 ? 1.0 : TRUST;
  for (let i = 0; i < 2; i++) {
    const miss = f[i] - memory.f[i] - (J[i][0] * dq[0] + J[i][1] * dq[1]);
    J[i][0] += share * miss * dq[0] / size;
    J[i][1] += share * miss * dq[1] / size;
  }
  memory.q = q;
  memory.f = f;
}

function act(seen) {
  if (seen.visible[0] === 1) learn(seen);
  memory.step += 1;
  if (memory.step <= PROBING) return memory.step <= PROBING / 2 ? [0.4, 0.0] : [0.0, 0.4];
  const [[a, b], [c, d]] = memory.J;
  const ex = seen.goal[0] - seen.features[0], ey = seen.goal[1] - seen.features[1];
  // The inverse of the Jacobian, damped so that rates stay small where it is singular.
  const determinant = a * d - b * c;
  const scale = GAIN * determinant / (determinant * determinant + 1e4) / maxJointRate;
  return [scale * (d * ex - b * ey), scale * (a * ey - c * ex)];
}

require("node:readline").createInterface({ input: process.stdin }).on("line", (line) => {
  const message = JSON.parse(line);
  if (message.message === "environment") {
    maxJointRate = message.max_joint_rate;
  } else if (message.message === "end") {
    process.exit(0);
  } else {
    if (message.message === "reset") memory = begin(message.observation);
    process.stdout.write(JSON.stringify(act(message.observation)) + "\n");
  }
});

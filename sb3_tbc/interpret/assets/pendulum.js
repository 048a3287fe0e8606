'use strict';
// Pendulum, step for step as tasks/pendulum.py, and its picture.

const PENDULUM = {
  maxSteps: 1000,
  goalHelp: 'Drag the green rod to move the goal. Goals within 16 degrees of upright were part of training.',

  begin: (start) => ({ angle: start.qpos[0], speed: start.qvel[0] }),

  advance(state, action) {
    const TIME = 0.002, HEIGHT = 0.6, LENGTH = 0.5, INERTIA = 0.001, DAMPING = 0.1, GRAVITY = 9.81, MASS = 1.0;
    const torque = Math.min(Math.max(action[0], -2), 2);
    let { angle, speed } = state;
    for (let k = 0; k < 10; k++) {
      const half = 0.5 * angle;
      let c = Math.cos(half), s = Math.sin(half);
      const x = 2.0 * LENGTH * (c * s);
      c = c * c;
      s = s * s;
      const z = (HEIGHT + LENGTH * (c - s)) - HEIGHT, unit = c + s, zSpeed = z * speed;
      const bias = MASS * (x * (speed * zSpeed - GRAVITY) - z * (speed * (x * speed)));
      const inertia = MASS * (unit * (unit * INERTIA) + z * z + x * x) + TIME * DAMPING;
      speed += TIME * ((torque - (DAMPING * speed + bias)) * (1.0 / inertia));
      angle += TIME * speed;
    }
    state.angle = angle;
    state.speed = speed;
  },

  observe({ angle, speed }) {
    const turn = 2 * Math.PI, wrapped = ((angle + Math.PI) % turn + turn) % turn - Math.PI;
    return {
      observation: [Math.cos(angle), Math.sin(angle), speed],
      achieved_goal: [wrapped, Math.min(Math.max(speed, -15), 15)],
    };
  },

  reached: (achieved, goal) =>
    Math.abs(achieved[0] - goal[0]) <= (9.5 / 180) * Math.PI && Math.abs(achieved[1] - goal[1]) <= 0.6,

  draw(pen, state, goal, subgoal) {
    pen.world(-1.15, -0.72, 2.3, 1.44);
    pen.line([[-0.9, 0], [0.9, 0]], 'line', 0.012);
    const rod = (angle, colour, width, alpha) => {
      const tip = [0.5 * Math.sin(angle), 0.5 * Math.cos(angle)];
      pen.line([[0, 0], tip], colour, width, alpha);
      pen.circle(tip, 0.05, colour, Math.min(1, alpha + 0.2));
    };
    rod(goal[0], 'goal', 0.03, 0.55);
    if (subgoal) rod(subgoal[0], 'subgoal', 0.03, 0.55);
    rod(state.angle, 'ink', 0.026, 1);
    pen.circle([0, 0], 0.022, 'ink', 1);
    const at = (v) => [Math.min(Math.max(v / 15, -1.05), 1.05) * 0.9, -0.62];
    pen.line([at(-15), at(15)], 'line', 0.01);
    pen.circle(at(goal[1]), 0.034, 'goal', 0.9);
    if (subgoal) pen.circle(at(subgoal[1]), 0.028, 'subgoal', 0.9);
    pen.circle(at(state.speed), 0.02, 'ink', 1);
    pen.text('velocity', [0, -0.55], 'muted');
  },

  /** The goal that a point of the picture stands for. */
  goalAt: (point, goal) => [Math.atan2(point[0], point[1]), goal[1]],
  describe: (state) => `angle ${(state.angle * 180 / Math.PI).toFixed(0)}°, velocity ${state.speed.toFixed(1)} rad/s`,
};

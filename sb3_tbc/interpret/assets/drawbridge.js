'use strict';
// Drawbridge, step for step as tasks/drawbridge.py (compact observation), and its picture.

const DRAWBRIDGE = {
  maxSteps: 1000,
  goalHelp: 'Drag the green flag to move the goal along the canal. Training knew one goal alone.',

  begin: () => ({ position: 0, speed: 0, sails: 0, elapsed: 0, angle: -0, phase: -1 }),

  advance(state, action) {
    const a = Math.min(Math.max(action[0], -1), 1), clip = (x, low, high) => Math.min(Math.max(x, low), high);
    state.sails = clip(state.sails + 0.03 * a, 0, 1);
    state.position = clip(state.position + state.speed, 0, 10);
    state.speed = clip(state.speed + 0.0001 * state.sails, -0.03, 0.03);
    state.angle = -Math.min(Math.max(state.elapsed - 500, 0) * 0.4, 90);
    state.phase = (2 * state.elapsed) / 1000 - 1;
    if (state.angle > -25 && state.position > 4.3 && state.speed > 0) state.speed *= -0.1;
    state.elapsed += 1;
  },

  observe({ position, speed, sails, phase }) {
    const place = (2 * position) / 10 - 1;
    return { observation: [phase, 2 * sails - 1, place, speed / 0.03], achieved_goal: [place] };
  },

  reached: (achieved, goal) => Math.abs(achieved[0] - goal[0]) <= 0.1,

  draw(pen, state, goal, subgoal) {
    pen.world(-0.9, -1.7, 11.4, 5.1);
    pen.box([-0.9, -1.7], [11.4, 1.7], 'water', 1);
    const flag = (goal[0] + 1) * 5;
    pen.line([[flag, 0], [flag, 1.5]], 'goal', 0.06);
    pen.polygon([[flag, 1.5], [flag, 1.1], [flag + 0.5, 1.3]], 'goal', 1);
    pen.line([[flag - 0.5, -0.03], [flag + 0.5, -0.03]], 'goal', 0.1);
    const turn = (-state.angle * Math.PI) / 180, hinge = [4.85, 0.75];
    pen.box([4.85, -1.7], [0.2, 2.5], 'line', 1);
    pen.line([hinge, [hinge[0] - 0.93 * Math.cos(turn), hinge[1] + 0.93 * Math.sin(turn)]], 'ink', 0.13);
    const ship = (x, speed, sails, hull, cloth, alpha) => {
      pen.polygon([[x - 0.75, 0.16], [x, 0.16], [x - 0.15, -0.16], [x - 0.62, -0.16]], hull, alpha);
      pen.line([[x - 0.4, 0.1], [x - 0.4, 1.25]], hull, 0.05, alpha);
      pen.polygon([[x - 0.36, 1.2], [x - 0.36, 1.2 - 0.9 * sails], [x + 0.12, 1.2 - 0.9 * sails]], cloth, alpha);
      pen.line([[x - 0.35, -0.45], [x - 0.35 + speed / 0.03, -0.45]], cloth, 0.06, alpha);
    };
    if (subgoal) ship((subgoal[0] + 1) * 5, subgoal[1] * 0.03, (subgoal[2] + 1) / 2, 'subgoal', 'subgoal', 0.6);
    ship(state.position, state.speed, state.sails, 'ink', 'accent', 1);
    pen.text(`bridge ${state.angle <= -25 ? 'open' : 'closed'}, ${Math.abs(state.angle).toFixed(0)}°`, [4.4, 2.6], 'muted');
  },

  goalAt: (point) => [Math.min(Math.max(point[0] / 5 - 1, -1), 1)],
  describe: (s) => `position ${s.position.toFixed(2)}, velocity ${s.speed.toFixed(4)}, sails ${(100 * s.sails).toFixed(0)} %`,
};

const SIMULATED = { Pendulum: PENDULUM, Drawbridge: DRAWBRIDGE };

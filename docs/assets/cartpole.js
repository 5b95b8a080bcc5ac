// CartPole-v1 and the Q-network of the package in JavaScript: what watch_it_learn.js plays with.
// tests/test_watch_it_learn.py compares both with the package.
"use strict";

const GRAVITY = 9.8; // m/s^2
const MASS_CART = 1.0, MASS_POLE = 0.1; // kg
const TOTAL_MASS = MASS_CART + MASS_POLE;
const HALF_LENGTH = 0.5; // m
const POLE_MOMENT = MASS_POLE * HALF_LENGTH; // kg m
const FORCE = 10.0; // N
const TIME_STEP = 0.02; // s, one step
const MAX_ANGLE = (12 * 2 * Math.PI) / 360; // rad
const MAX_POSITION = 2.4; // m
const MAX_STEPS = 500; // then time is up

/** The force of an action: push to the left (0) or to the right (1). */
function forceOf(action) {
  return action === 1 ? FORCE : -FORCE;
}

/** The next state: one explicit Euler step. A state is [position, velocity, angle, angular velocity]. */
function transition(state, force) {
  const [position, velocity, angle, angularVelocity] = state;
  const cos = Math.cos(angle), sin = Math.sin(angle);
  const push = (force + POLE_MOMENT * angularVelocity ** 2 * sin) / TOTAL_MASS;
  const angularAcceleration =
    (GRAVITY * sin - cos * push) / (HALF_LENGTH * (4.0 / 3.0 - (MASS_POLE * cos ** 2) / TOTAL_MASS));
  const acceleration = push - (POLE_MOMENT * angularAcceleration * cos) / TOTAL_MASS;
  return [
    position + TIME_STEP * velocity,
    velocity + TIME_STEP * acceleration,
    angle + TIME_STEP * angularVelocity,
    angularVelocity + TIME_STEP * angularAcceleration,
  ];
}

function hasLeftTheTrack(state) {
  return Math.abs(state[0]) > MAX_POSITION;
}

function hasFallen(state) {
  return Math.abs(state[2]) > MAX_ANGLE;
}

function isTerminal(state) {
  return hasLeftTheTrack(state) || hasFallen(state);
}

/** One dense layer: inputs [F], kernel [F][U], bias [U] -> [U]. */
function dense(inputs, kernel, bias) {
  const outputs = bias.slice();
  for (let i = 0; i < inputs.length; i++) {
    for (let unit = 0; unit < outputs.length; unit++) outputs[unit] += inputs[i] * kernel[i][unit];
  }
  return outputs;
}

/** [Q(s, left), Q(s, right)], from the weights as Keras gives them: kernel and bias of each layer. */
function qValues([hiddenKernel, hiddenBias, kernel, bias], state) {
  const hidden = dense(state, hiddenKernel, hiddenBias).map((x) => Math.max(x, 0));
  return dense(hidden, kernel, bias);
}

/** The action with the highest Q-value; the first, if they are equal. */
function greedyAction([left, right]) {
  return right > left ? 1 : 0;
}

// The page "Watch it learn": the networks of RUN (snapshots.js) play CartPole (cartpole.js).
"use strict";

(() => {
  const PUSH_STEPS = 5; // a push takes at least this many
  const REST_STEPS = 30; // from the end of an episode to the next
  const TRAIL_STEPS = 50;
  const DEGREES = 180 / Math.PI;
  const MAP_VELOCITY = 3; // rad/s, the upper edge of the map
  const MAX_Q = 1 / (1 - RUN.gamma); // the highest possible return: a reward of 1 at every step
  const VIRIDIS = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"]; // as in Matplotlib
  const LAST_EPISODE = RUN.rewards.length - 1;

  const find = (selector) => document.querySelector(selector);
  const show = (id, text) => (document.getElementById(id).textContent = text);
  /** A number with so many decimals, a true minus, and no minus before a zero. */
  const fixed = (number, digits) => (Number(number.toFixed(digits)) + 0).toFixed(digits).replace("-", "−");

  let chosen = 0; // index in RUN.snapshots
  let start = 0; // index in RUN.starts
  let state, previous, trail, numSteps;
  let rest = 0; // steps until the next episode starts; 0 during an episode
  let request = 0; // for the next frame; 0 in a pause
  const push = { direction: 0, isHeld: false, steps: 0 };

  // The episode

  function startEpisode() {
    state = previous = RUN.starts[start];
    trail = [state];
    numSteps = rest = 0;
    draw(1);
  }

  function nextEpisode() {
    start = (start + 1) % RUN.starts.length;
    if (find("#film").checked) {
      choose(Math.min(chosen + 1, RUN.snapshots.length - 1));
    } else {
      startEpisode();
    }
  }

  /** Does what happens in one fiftieth of a second. */
  function step() {
    if (rest > 0) {
      previous = state;
      rest -= 1;
      if (rest === 0) nextEpisode();
      return;
    }
    const force = forceOf(greedyAction(qValues(RUN.snapshots[chosen].weights, state)));
    previous = state;
    state = transition(state, force + FORCE * pushDirection());
    push.steps -= 1;
    numSteps += 1;
    trail = [...trail.slice(1 - TRAIL_STEPS), state];
    if (isTerminal(state) || numSteps === MAX_STEPS) endEpisode();
  }

  function endEpisode() {
    const reason = hasFallen(state)
      ? "the pole fell"
      : hasLeftTheTrack(state)
        ? "the cart left the track"
        : "time was up, and the pole stood";
    show("result", `Network of episode ${RUN.snapshots[chosen].episode}: ${reason} after ${numSteps} steps.`);
    rest = REST_STEPS;
  }

  // Time

  function play() {
    if (request !== 0) return;
    show("play", "Pause");
    let last = performance.now(), behind = 0; // ms
    const frame = (now) => {
      behind += clip(now - last, 0, 100); // a page that was hidden does not catch up
      last = now;
      for (; behind >= 1000 * TIME_STEP; behind -= 1000 * TIME_STEP) step();
      draw(behind / (1000 * TIME_STEP));
      request = requestAnimationFrame(frame);
    };
    request = requestAnimationFrame(frame);
  }

  function pause() {
    cancelAnimationFrame(request);
    request = 0;
    show("play", "Play");
    draw(1);
  }

  const togglePlay = () => (request === 0 ? play() : pause());

  // Pushes

  const pushDirection = () => (push.isHeld || push.steps > 0 ? push.direction : 0);

  function press(direction) {
    Object.assign(push, { direction, isHeld: true, steps: PUSH_STEPS });
    play();
  }

  function release() {
    push.isHeld = false;
  }

  // The choice of a network

  function choose(index) {
    const { episode, epsilon } = RUN.snapshots[(chosen = index)];
    find("#episode").value = episode;
    find("#episode").setAttribute("aria-valuetext", `episode ${episode}`);
    find("#curve .marker").setAttribute("d", `M${episode} 0V${MAX_STEPS}`);
    show("chosen", episode);
    show("reward", RUN.rewards[episode]);
    show("epsilon", `${fixed(100 * epsilon, 0)} %`);
    drawMap();
    startEpisode();
  }

  function chooseByHand(index) {
    find("#film").checked = false;
    followFilm();
    show("result", "");
    choose(Math.max(0, Math.min(index, RUN.snapshots.length - 1)));
  }

  function nearestSnapshot(episode) {
    const distances = RUN.snapshots.map((snapshot) => Math.abs(snapshot.episode - episode));
    return distances.indexOf(Math.min(...distances));
  }

  /** A screen reader says each result, but not during the film. */
  function followFilm() {
    find("#result").setAttribute("aria-live", find("#film").checked ? "off" : "polite");
  }

  // Drawing

  /** Draws the cart between the previous state (0) and the present one (1), and all else as it is at present. */
  function draw(fraction) {
    const between = (i) => previous[i] + fraction * (state[i] - previous[i]);
    find("#cart").setAttribute("transform", `translate(${between(0)})`);
    find("#pole").setAttribute("transform", `rotate(${between(2) * DEGREES})`);
    find("#push").setAttribute("class", pushDirection() === 0 ? "hidden" : "");
    find("#push").setAttribute("transform", `scale(${push.direction || 1} 1)`);
    const [position, velocity, angle, angularVelocity] = state;
    show("step", `${numSteps} / ${MAX_STEPS}`);
    show("position", fixed(position, 2));
    show("velocity", fixed(velocity, 2));
    show("angle", fixed(angle * DEGREES, 1));
    show("angular-velocity", fixed(angularVelocity, 2));
    drawBars();
    drawDot();
  }

  function drawBars() {
    const q = qValues(RUN.snapshots[chosen].weights, state);
    ["#q-left", "#q-right"].forEach((bar, action) => {
      find(bar).classList.toggle("greedy", action === greedyAction(q));
      find(`${bar} b`).style.transform = `scaleX(${clip(q[action] / MAX_Q, 0, 1)})`;
      find(`${bar} .value`).textContent = fixed(q[action], 2);
    });
  }

  /** Where a state is in the map, in degrees and rad/s, the latter growing downwards; at its edge, if it is outside. */
  function placeInMap([, , angle, angularVelocity]) {
    return [
      clip(angle, -MAX_ANGLE, MAX_ANGLE) * DEGREES,
      -clip(angularVelocity, -MAP_VELOCITY, MAP_VELOCITY),
    ];
  }

  function drawDot() {
    const points = trail.map((s) => placeInMap(s).join()).join(" ");
    document.querySelectorAll(".watch .trail").forEach((line) => line.setAttribute("points", points));
    const [x, y] = placeInMap(state);
    find("#dot").style.left = `${50 + (50 * x) / (MAX_ANGLE * DEGREES)}%`;
    find("#dot").style.top = `${50 + (50 * y) / MAP_VELOCITY}%`;
  }

  function drawMap() {
    const canvas = find("#map"), { width, height } = canvas;
    const context = canvas.getContext("2d");
    const { weights, episode } = RUN.snapshots[chosen];
    const showsAction = find("[name=map]:checked").value === "action";
    const colours = ["--left", "--right"].map((name) => rgba(getComputedStyle(canvas).getPropertyValue(name).trim()));
    const image = context.createImageData(width, height);
    for (let row = 0; row < height; row++) {
      for (let column = 0; column < width; column++) {
        const angle = MAX_ANGLE * ((2 * column) / (width - 1) - 1);
        const angularVelocity = MAP_VELOCITY * (1 - (2 * row) / (height - 1));
        const q = qValues(weights, [0, 0, angle, angularVelocity]);
        const colour = showsAction ? colours[greedyAction(q)] : colourOf(Math.max(...q) / MAX_Q);
        image.data.set(colour, 4 * (row * width + column));
      }
    }
    context.putImageData(image, 0, 0);
    const shown = showsAction ? "Better action" : "Highest Q-value";
    canvas.setAttribute("aria-label", `${shown} of the network of episode ${episode}, by angle and angular velocity`);
  }

  function drawCurve() {
    const { rewards, solved_reward: solvedReward, solved_window: window } = RUN;
    const means = rewards.map((_, i) => mean(rewards.slice(Math.max(0, i + 1 - window), i + 1)));
    const points = (values) => values.map((value, i) => `${i},${MAX_STEPS - value}`);
    find("#curve").setAttribute("viewBox", `0 0 ${LAST_EPISODE} ${MAX_STEPS}`);
    find("#curve .rewards").setAttribute("points", points(rewards).join(" "));
    find("#curve .mean").setAttribute("points", points(means).slice(window - 1).join(" "));
    find("#curve .solved").setAttribute("d", `M0 ${MAX_STEPS - solvedReward}H${LAST_EPISODE}`);
  }

  const clip = (x, low, high) => Math.max(low, Math.min(x, high));
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const rgba = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)).concat(255);

  const VIRIDIS_RGBA = VIRIDIS.map(rgba);

  /** The colour of a share of the highest possible Q-value. */
  function colourOf(share) {
    const place = clip(share, 0, 1) * (VIRIDIS.length - 1);
    const i = Math.min(Math.floor(place), VIRIDIS.length - 2);
    const [below, above] = [VIRIDIS_RGBA[i], VIRIDIS_RGBA[i + 1]];
    return below.map((value, channel) => value + (place - i) * (above[channel] - value));
  }

  // What the reader does

  const DIRECTIONS = { a: -1, arrowleft: -1, d: 1, arrowright: 1 };
  const SLIDER_STEPS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 };

  function listen() {
    find("#play").addEventListener("click", togglePlay);
    find("#reset").addEventListener("click", startEpisode);
    holdToPush(find("#push-left"), () => -1);
    holdToPush(find("#push-right"), () => 1);
    const cart = find("#cart .body");
    holdToPush(find("#scene"), ({ clientX }) => {
      const { left, width } = cart.getBoundingClientRect();
      return clientX < left + width / 2 ? -1 : 1;
    });
    pushByKeys(find("#scene"));

    const slider = find("#episode");
    slider.addEventListener("input", () => chooseByHand(nearestSnapshot(slider.value)));
    slider.addEventListener("keydown", (event) => {
      if (!(event.key in SLIDER_STEPS)) return;
      event.preventDefault();
      chooseByHand(chosen + SLIDER_STEPS[event.key]);
    });
    find("#curve").addEventListener("click", ({ clientX }) => {
      const { left, width } = slider.getBoundingClientRect();
      chooseByHand(nearestSnapshot((LAST_EPISODE * (clientX - left - 8)) / (width - 16)));
    });
    find("#film").addEventListener("change", followFilm);
    document.querySelectorAll("[name=map]").forEach((radio) => radio.addEventListener("change", drawMap));
  }

  function holdToPush(element, directionOf) {
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      element.setPointerCapture(event.pointerId);
      press(directionOf(event));
    });
    for (const end of ["pointerup", "pointercancel", "blur"]) element.addEventListener(end, release);
    element.addEventListener("contextmenu", (event) => event.preventDefault()); // a long touch
    element.addEventListener("click", (event) => {
      if (event.detail !== 0) return; // of a pointer
      press(directionOf(event));
      release();
    });
  }

  function pushByKeys(element) {
    element.addEventListener("keydown", (event) => {
      const direction = DIRECTIONS[event.key.toLowerCase()];
      if (event.altKey || event.ctrlKey || event.metaKey || !(direction || event.key === " ")) return;
      event.preventDefault();
      if (event.repeat) return;
      if (direction) press(direction);
      else togglePlay();
    });
    element.addEventListener("keyup", ({ key }) => {
      if (DIRECTIONS[key.toLowerCase()] === push.direction) release();
    });
  }

  find("#episode").max = LAST_EPISODE;
  show("last", LAST_EPISODE);
  find("#colours").style.background = `linear-gradient(to right, ${VIRIDIS.join()})`;
  drawCurve();
  listen();
  followFilm();
  choose(0);
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play();
})();

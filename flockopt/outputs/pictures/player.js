"use strict";
// The page: what is in the scene, where everyone is at a time, the camera, and the controls.

const flight = JSON.parse(document.getElementById("flight").textContent);
const element = (id) => document.getElementById(id);
const [lower, upper] = [flight.bounds.lower, flight.bounds.upper];
const middle = lower.map((low, k) => (low + upper[k]) / 2);
const extent = Math.hypot(upper[0] - lower[0], upper[1] - lower[1]);
const state = { now: 0, playing: false, chosen: -1, names: true, azimuth: 0, elevation: 0, distance: 0, target: middle };

// ---- Motion: the plan's own polynomials ---------------------------------------------------------------

function pieceAt(drone, time) {
  let low = 0, high = drone.coefficients.length - 1;
  while (low < high) {
    const half = (low + high + 1) >> 1;
    if (drone.breakpoints[half] <= time) low = half; else high = half - 1;
  }
  return low;
}

function stateAt(drone, time) {
  if (!drone.coefficients.length) return { position: drone.start, acceleration: [0, 0, 0] };
  const first = drone.breakpoints[0], last = drone.breakpoints[drone.breakpoints.length - 1];
  const inside = Math.min(Math.max(time, first), last), piece = pieceAt(drone, inside);
  const local = inside - drone.breakpoints[piece], moving = time >= first && time <= last;
  const position = [], acceleration = [];
  for (const terms of drone.coefficients[piece]) {
    let p = 0, a = 0;
    for (let n = terms.length - 1; n >= 0; n--) {
      p = p * local + terms[n];
      if (n >= 2) a = a * local + n * (n - 1) * terms[n];
    }
    position.push(p);
    acceleration.push(moving ? a : 0);
  }
  return { position, acceleration };
}

// A quadrotor leans so that its thrust gives its acceleration against gravity.
function pose(drone, scale) {
  const { position, acceleration } = stateAt(drone, state.now);
  const up = unit([acceleration[0], acceleration[1], acceleration[2] + 9.81]);
  const left = unit(cross(up, [1, 0, 0])), ahead = cross(left, up);
  return new Float32Array([...scaled(ahead, scale), 0, ...scaled(left, scale), 0, ...scaled(up, scale), 0, ...position, 1]);
}

// ---- What is drawn -------------------------------------------------------------------------------------

const gl = element("view").getContext("webgl2", { antialias: true, alpha: false });
if (!gl) element("failed").hidden = false;

function build() {
  const [solid, line, point] = [SOLID, LINE, POINT].map((source) => new Program(gl, source));
  const obstacles = new Mesh(), edges = [], ground = new Mesh();
  const tallest = Math.max(...flight.obstacles.map((o) => o.top), 1e-9);
  for (const obstacle of flight.obstacles) {
    const shade = 0.84 - 0.26 * Math.max(0, Math.min(1, obstacle.top / tallest)), color = [shade, shade + 0.01, shade + 0.03];
    if (obstacle.shape === "sphere") { obstacles.sphere(obstacle.center, obstacle.radius, color); continue; }
    const around = footprint(obstacle), n = around.length;
    obstacles.prism(around, obstacle.bottom, obstacle.top, color, obstacle.shape === "cylinder");
    around.forEach((p, i) => {
      const q = around[(i + 1) % n];
      for (const z of [obstacle.bottom, obstacle.top]) addLine(edges, [...p, z], [...q, z], [0.42, 0.46, 0.53]);
      if (obstacle.shape === "box") addLine(edges, [...p, obstacle.bottom], [...p, obstacle.top], [0.42, 0.46, 0.53]);
    });
  }
  const floor = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => [u ? upper[0] : lower[0], v ? upper[1] : lower[1], lower[2]]);
  ground.quad(...floor, [1, 1, 1], [0, 0, 1]);
  return {
    solid, line, point,
    obstacles: solid.upload(obstacles.numbers, SOLID_LAYOUT), ground: solid.upload(ground.numbers, SOLID_LAYOUT),
    drone: solid.upload(quadrotor().numbers, SOLID_LAYOUT), edges: line.upload(edges, LINE_LAYOUT),
    grid: line.upload(gridLines(), LINE_LAYOUT), routes: line.upload(routeLines(), LINE_LAYOUT),
    tasks: point.upload(taskPoints(), POINT_LAYOUT),
  };
}

function gridLines() {
  const numbers = [], step = 10 ** Math.floor(Math.log10(extent / 4)), z = lower[2];
  const gray = [0.86, 0.88, 0.91];
  for (let x = Math.ceil(lower[0] / step) * step; x <= upper[0]; x += step) addLine(numbers, [x, lower[1], z], [x, upper[1], z], gray);
  for (let y = Math.ceil(lower[1] / step) * step; y <= upper[1]; y += step) addLine(numbers, [lower[0], y, z], [upper[0], y, z], gray);
  const dark = [0.62, 0.66, 0.72], corners = [[lower[0], lower[1]], [upper[0], lower[1]], [upper[0], upper[1]], [lower[0], upper[1]]];
  corners.forEach((p, i) => addLine(numbers, [...p, z], [...corners[(i + 1) % 4], z], dark));
  return numbers;
}

function routeLines() {
  const numbers = [], steps = flight.drones.length > 60 ? 8 : 20;
  flight.drones.forEach((drone, index) => {
    for (let piece = 0; piece < drone.coefficients.length; piece++) {
      const begin = drone.breakpoints[piece], span = drone.breakpoints[piece + 1] - begin;
      for (let k = 0; k < steps; k++) {
        const [a, b] = [begin + span * k / steps, begin + span * (k + 1) / steps];
        addLine(numbers, stateAt(drone, a).position, stateAt(drone, b).position, rgb(drone.color), a, b, index);
      }
    }
  });
  return numbers;
}

function taskPoints() {
  const numbers = [];
  for (const task of flight.tasks) numbers.push(...task.position, ...rgb(task.color), task.time ?? 1e9);
  return numbers;
}

// ---- Camera --------------------------------------------------------------------------------------------

function lookFrom(elevation, azimuth) {
  const aspect = innerWidth / innerHeight;
  Object.assign(state, { elevation, azimuth, target: [middle[0], middle[1], lower[2] + 0.2 * (upper[2] - lower[2])] });
  state.distance = 1.2 * extent / Math.min(1, 0.7 * aspect);
}

function camera() {
  const [ce, se] = [Math.cos(state.elevation), Math.sin(state.elevation)];
  const back = [ce * Math.cos(state.azimuth), ce * Math.sin(state.azimuth), se];
  const right = [-Math.sin(state.azimuth), Math.cos(state.azimuth), 0], up = cross(back, right);
  const eye = state.target.map((value, k) => value + state.distance * back[k]);
  const projection = perspective(0.75, innerWidth / innerHeight, 0.01 * state.distance, 20 * state.distance + 10 * extent);
  // The middle of the view is the middle of what the cards leave free.
  if (innerWidth > 700) projection[8] = -(element("about").offsetWidth + 14) / innerWidth;
  projection[9] = -(element("bar").offsetHeight + 14) / innerHeight;
  return { eye, right, up, back, matrix: multiply(projection, lookAt(eye, right, up, back)) };
}

function project(matrix, p) {
  const at = (row) => matrix[row] * p[0] + matrix[4 + row] * p[1] + matrix[8 + row] * p[2] + matrix[12 + row];
  const w = at(3);
  return w > 0 ? [(0.5 + 0.5 * at(0) / w) * innerWidth, (0.5 - 0.5 * at(1) / w) * innerHeight] : null;
}

// ---- One frame -----------------------------------------------------------------------------------------

const IDENTITY = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
const built = gl && build();

function fit(canvas, ratio) {
  const [wide, high] = [Math.round(innerWidth * ratio), Math.round(innerHeight * ratio)];
  if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
}

function drawFrame() {
  const ratio = devicePixelRatio || 1, view = camera(), { solid, line, point } = built;
  fit(gl.canvas, ratio);
  gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
  gl.clearColor(0.933, 0.945, 0.961, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  gl.depthFunc(gl.LEQUAL);
  const lines = { camera: view.matrix, viewport: [gl.canvas.width, gl.canvas.height], now: state.now, chosen: -1, opacity: 1 };

  solid.use({ camera: view.matrix, model: IDENTITY, tint: [1, 1, 1, 1] });
  solid.draw(built.ground);
  gl.depthMask(false);
  line.use({ ...lines, width: 1 * ratio });
  line.draw(built.grid);
  line.use({ ...lines, width: 2.6 * ratio, chosen: state.chosen });
  line.draw(built.routes);
  gl.depthMask(true);
  drawDrones(view, solid, ratio);
  point.use({ camera: view.matrix, size: (flight.tasks.length > 300 ? 6 : 10) * ratio, now: state.now });
  point.draw(built.tasks, gl.POINTS);

  // Obstacles last, half transparent over what is behind them, their own nearest faces only.
  solid.use({ camera: view.matrix, model: IDENTITY, tint: [1, 1, 1, 0.68] });
  gl.colorMask(false, false, false, false);
  solid.draw(built.obstacles);
  gl.colorMask(true, true, true, true);
  solid.draw(built.obstacles);
  line.use({ ...lines, width: 1 * ratio, opacity: 0.75 });
  line.draw(built.edges);
  drawNames(view, ratio);
}

function drawDrones(view, solid, ratio) {
  flight.drones.forEach((drone, index) => {
    const { position } = stateAt(drone, state.now);
    // True to scale near by; far off never smaller than can be seen.
    const visible = 0.0095 * Math.abs(dot(subtract(position, view.eye), view.back));
    const faded = state.chosen >= 0 && state.chosen !== index;
    solid.use({ camera: view.matrix, model: pose(drone, Math.max(drone.radius, visible)), tint: [...rgb(drone.color), faded ? 0.25 : 1] });
    solid.draw(built.drone);
  });
}

function drawNames(view, ratio) {
  const canvas = element("labels"), context = canvas.getContext("2d");
  fit(canvas, ratio);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, innerWidth, innerHeight);
  if (!state.names) return;
  context.lineWidth = 3;
  context.strokeStyle = "rgba(255, 255, 255, .85)";
  const taken = [];
  const write = (words, place, color, font) => {
    const at = project(view.matrix, place);
    if (!at) return;
    context.font = font;
    const [x, y, wide] = [at[0] + 8, at[1] - 7, context.measureText(words).width];
    if (taken.some(([left, base, width]) => x < left + width + 2 && left < x + wide + 2 && Math.abs(base - y) < 11)) return;
    taken.push([x, y, wide]);
    context.fillStyle = color;
    context.strokeText(words, x, y);
    context.fillText(words, x, y);
  };
  if (flight.drones.length <= 60) for (const drone of flight.drones)
    write(drone.id, stateAt(drone, state.now).position, drone.color, "bold 12px system-ui, sans-serif");
  if (flight.tasks.length <= 100) for (const task of flight.tasks) write(task.id, task.position, "#5a6472", "11px system-ui, sans-serif");
}

// ---- Time and controls ---------------------------------------------------------------------------------

function valueNow(series) {
  const { times } = flight.series, share = Math.min(state.now / times[times.length - 1], 1) * (times.length - 1);
  const index = Math.min(Math.floor(share), times.length - 2);
  return series[index] + (share - index) * (series[index + 1] - series[index]);
}

function showTime() {
  element("time").value = state.now;
  element("clock").textContent = `${state.now.toFixed(1)} / ${flight.makespan.toFixed(1)} s`;
  element("play").textContent = state.playing ? "Pause" : "Play";
  if (!flight.series) return;
  const rows = [["separation", flight.separation], ["clearance", flight.clearance]].filter(([name]) => flight.series[name]);
  element("least").replaceChildren(...rows.flatMap(([name, required]) => {
    const [words, number] = [document.createElement("span"), document.createElement("b")];
    words.textContent = `least ${name} now`;
    words.title = `required: ${required} m`;
    number.textContent = `${valueNow(flight.series[name]).toFixed(2)} m`;
    const rule = document.createElement("span"), need = document.createElement("span");
    rule.textContent = "required";
    need.textContent = `${required.toFixed(2)} m`;
    need.style.textAlign = "right";
    rule.className = need.className = "quiet";
    return [words, number, rule, need];
  }));
}

function listFleet() {
  document.title = flight.name;
  document.querySelector("h1").textContent = flight.name;
  for (const fact of flight.facts) element("facts").appendChild(document.createElement("div")).textContent = fact;
  flight.drones.forEach((drone, index) => {
    const row = document.createElement("button"), [dot, name, tasks, metres] = ["i", "b", "span", "span"].map((tag) => document.createElement(tag));
    dot.style.background = drone.color;
    name.textContent = drone.id;
    tasks.textContent = tasks.title = drone.tasks.join(" → ") || (flight.makespan ? "stays" : "");
    metres.textContent = drone.length === null ? "" : `${drone.length.toFixed(1)} m`;
    row.append(dot, name, tasks, metres);
    row.setAttribute("aria-pressed", "false");
    row.onclick = () => {
      state.chosen = state.chosen === index ? -1 : index;
      [...element("fleet").children].forEach((other, k) => other.setAttribute("aria-pressed", String(k === state.chosen)));
    };
    element("fleet").append(row);
  });
}

function listen() {
  const canvas = element("view"), fingers = new Map();
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
    if (others.length) {
      const reach = (x, y) => Math.hypot(x - others[0][0], y - others[0][1]) || 1;
      zoom(reach(...before) / reach(event.clientX, event.clientY));
      pan(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) pan(dx, dy);
    else {
      state.azimuth -= 0.006 * dx;
      state.elevation = Math.min(Math.PI / 2 - 1e-3, Math.max(-0.2, state.elevation + 0.006 * dy));
    }
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(0.0012 * event.deltaY)); }, { passive: false });
  element("play").onclick = toggle;
  element("time").oninput = (event) => { state.now = Number(event.target.value); };
  element("above").onclick = () => lookFrom(Math.PI / 2 - 1e-3, -Math.PI / 2);
  element("home").onclick = () => lookFrom(0.72, -1.15);
  element("labelled").onclick = () => { state.names = !state.names; };
  addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.5, ArrowRight: 0.5 }[event.key];
    if (event.key === " " && event.target.tagName !== "BUTTON") { event.preventDefault(); toggle(); }
    else if (step && event.target === document.body) state.now = Math.min(flight.makespan, Math.max(0, state.now + step));
  });
}

function zoom(factor) { state.distance = Math.min(20 * extent, Math.max(0.01 * extent, state.distance * factor)); }

function pan(dx, dy) {
  const view = camera(), metres = 0.79 * state.distance / innerHeight;
  state.target = state.target.map((value, k) => value + metres * (dy * view.up[k] - dx * view.right[k]));
}

function toggle() {
  state.playing = !state.playing;
  if (state.playing && state.now >= flight.makespan) state.now = 0;
}

let before = null;
function tick(stamp) {
  const passed = before === null ? 0 : Math.min(0.1, (stamp - before) / 1000);
  before = stamp;
  if (state.playing) {
    state.now = Math.min(flight.makespan, state.now + passed * Number(element("speed").value));
    if (state.now >= flight.makespan) state.playing = false;
  }
  showTime();
  drawFrame();
  requestAnimationFrame(tick);
}

function begin() {
  listFleet();
  element("time").max = flight.makespan;
  element("least").hidden = !flight.series || !(flight.series.separation || flight.series.clearance);
  element("bar").querySelectorAll("#play, #time, #clock, #speed").forEach((control) => { control.hidden = !flight.makespan; });
  lookFrom(0.72, -1.15);
  const asked = new URLSearchParams(location.hash.slice(1)).get("t"); // page.html#t=3.5 opens at that second
  state.now = Math.min(flight.makespan, Math.max(0, Number(asked) || 0));
  state.playing = asked === null && flight.makespan > 0 && !matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (!gl) return;
  listen();
  requestAnimationFrame(tick);
}

begin();

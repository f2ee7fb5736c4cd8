"use strict";
/* Draws the charts of the page and moves the 3-D view in time; everything drawn comes from Plotly. */
window.report = (() => {
  let data = JSON.parse(document.getElementById("report-data").textContent);
  let motion = data.scene.motion;
  const scene = document.getElementById("flight");
  const slider = document.getElementById("time");
  const root = document.documentElement;
  const touch = window.matchMedia("(hover: none)").matches;
  const buttons = {
    view: [["toImage", "orbitRotation", "zoom3d", "pan3d", "resetCameraDefault3d"]],
    chart: [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
  };
  const config = (name) => ({
    displaylogo: false, responsive: true, scrollZoom: false, displayModeBar: touch ? false : "hover",
    modeBarButtons: buttons[name] || buttons.chart,
    toImageButtonOptions: { filename: `${data.file}-${name}`, scale: 2 },
  });
  let [start, end] = motion.ends_s;
  const { t_s: ticks, window_s: observed } = motion.plans[0];
  let time = Math.max((observed[0] + observed[1]) / 2, ticks[0]);
  let playing = false, printing = false;

  // ---- theme --------------------------------------------------------------------------------

  const systemDark = window.matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => !printing && (root.dataset.theme ? root.dataset.theme === "dark" : systemDark.matches);
  const colours = (dark) => (dark
    ? { ink: "#e8eaee", rule: "#3a414c", raised: "#1d2128" }
    : { ink: "#1c1f24", rule: "#d5d9df", raised: "#ffffff" });

  function themed(layout, dark = isDark()) {
    const { ink, rule } = colours(dark);
    const styled = {
      ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink, size: 12, family: "system-ui, sans-serif" },
    };
    for (const key of Object.keys(styled).filter((name) => /^[xy]axis\d*$/.test(name))) {
      styled[key] = { gridcolor: rule, zerolinecolor: rule, linecolor: rule, showline: true, automargin: true, exponentformat: "none", separatethousands: false, ...styled[key] };
    }
    if (styled.scene) {
      const axis = { gridcolor: rule, zerolinecolor: rule, color: ink, showbackground: false, showspikes: false };
      styled.scene = { ...styled.scene };
      const font = { color: ink, size: 12 };
      styled.scene.annotations = styled.scene.annotations.map((each) => ({ ...each, font }));
      for (const key of ["xaxis", "yaxis", "zaxis"]) styled.scene[key] = { ...axis, ...styled.scene[key] };
    }
    return styled;
  }

  // ---- mathematics --------------------------------------------------------------------------

  const product = (m, v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
  const transposed = (m) => m[0].map((_, j) => m.map((row) => row[j]));

  /* From body-fixed axes to those of the view: the axes at W = 0 turned by W about the third. */
  function attitude(t) {
    const { axes, meridian, rate, acceleration } = motion.rotation;
    const w = meridian + rate * t + 0.5 * acceleration * t * t;
    const [c, s] = [Math.cos(w), Math.sin(w)];
    return axes.map(([a, b, z]) => [c * a + s * b, -s * a + c * b, z]);
  }

  function sunAt(t) {
    const share = (t - start) / (end - start);
    return motion.sun[0].map((x, i) => x + share * (motion.sun[1][i] - x));
  }

  /* Index and share of a time among ascending ones, kept within them. */
  function between(times, t) {
    let low = 0, high = times.length - 1;
    if (t <= times[0]) return [0, 0];
    if (t >= times[high]) return [high - 1, 1];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle; else high = middle;
    }
    return [low, (t - times[low]) / (times[high] - times[low])];
  }

  const mix = (a, b, share) => (a === null || b === null ? null : a + share * (b - a));

  function along({ t_s, position }, t) {
    const [k, share] = between(t_s, t);
    return position.map((x) => mix(x[k], x[k + 1], share));
  }

  const craftAt = (plan, t) => along(motion.plans[plan], t);

  // ---- the view -----------------------------------------------------------------------------

  const basesOf = (traces) => traces.map(({ x, y, z }) => [x, y, z]);
  let bases = basesOf(data.scene.traces);

  function turned([x, y, z], m, shift = [0, 0, 0]) {
    return m.map((row, i) => x.map((_, k) => row[0] * x[k] + row[1] * y[k] + row[2] * z[k] + shift[i]));
  }

  /* Lines from the spacecraft to the edge of its view on the ground, and that edge. */
  function viewAt(plan, t, m) {
    const { looks_s, outlines, window_s } = motion.plans[plan];
    if (t < window_s[0] || t > window_s[1]) return [[null], [null], [null]];
    const [k, share] = between(looks_s, t);
    const craft = craftAt(plan, t);
    const ring = outlines[k].map((a, j) => a.map((x, i) => mix(x, outlines[k + 1][j][i], share)));
    const edge = ring.map((p) => (p.includes(null) ? [null, null, null] : product(m, p)));
    const points = [...edge, edge[0]];
    for (let j = 0; j < edge.length; j += edge.length / 4) points.push([null, null, null], craft, edge[j]);
    return transposed(points);
  }

  function cloudAt(plan, t) {
    const lines = data.scene.traces.findIndex((trace) => trace.meta.paths === plan);
    const nodes = motion.plans[plan].nodes_s;
    const [k, share] = between(nodes, t);
    return bases[lines].map((values) => {
      const found = [];
      for (let first = 0; first + nodes.length < values.length; first += nodes.length + 1) {
        found.push(mix(values[first + k], values[first + k + 1], share));
      }
      return found;
    });
  }

  /* Coordinates of a trace at a time, and the light on it. */
  function placed(trace, index, t, m) {
    const { moves, plan, lit } = trace.meta;
    if (moves === "body") {
      const xyz = turned(bases[index], m);
      if (!lit) return { xyz };
      const sun = product(transposed(m), sunAt(t));
      return { xyz, intensity: motion.normals.map((n) => n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]) };
    }
    if (moves === "site" || moves === "companion") {
      const shift = moves === "site" ? product(m, motion.site) : along(motion.companion, t);
      return { xyz: bases[index].map((values, i) => values.map((x) => x + shift[i])) };
    }
    if (moves === "craft") return { xyz: craftAt(plan, t).map((x) => [x]) };
    if (moves === "view") return { xyz: viewAt(plan, t, m) };
    return { xyz: cloudAt(plan, t) };
  }

  function moving(t, all) {
    const m = attitude(t);
    const found = [];
    data.scene.traces.forEach((trace, index) => {
      const shown = all || scene.data[index].visible !== false;
      if (trace.meta.moves && shown) found.push([index, placed(trace, index, t, m)]);
    });
    return found;
  }

  function drawn() {
    const traces = data.scene.traces.map((trace) => ({ ...trace }));
    for (const [index, { xyz, intensity }] of moving(time, true)) {
      [traces[index].x, traces[index].y, traces[index].z] = xyz;
      if (intensity) traces[index].intensity = intensity;
    }
    return traces;
  }

  async function show(t) {
    time = Math.min(Math.max(t, start), end);
    slider.value = String(time);
    readout();
    const places = moving(time, false);
    const lit = places.find(([, { intensity }]) => intensity);
    const update = {};
    ["x", "y", "z"].forEach((axis, i) => { update[axis] = places.map(([, { xyz }]) => xyz[i]); });
    if (lit) update.intensity = places.map(([, { intensity }]) => intensity);
    await Plotly.restyle(scene, update, places.map(([index]) => index));
    later();
  }

  const degrees = 180 / Math.PI;
  const angle = (a, b) => degrees * Math.acos(Math.min(1, Math.max(-1,
    (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / (Math.hypot(...a) * Math.hypot(...b)))));

  function readout() {
    const m = attitude(time);
    const said = motion.plans.map((plan, i) => {
      const site = product(m, plan.site);
      const away = Math.hypot(...craftAt(i, time).map((x, j) => x - site[j]));
      const leg = plan.legs.find(([, from, to]) => time >= from && time <= to && to > from);
      const name = motion.plans.length > 1 ? `${plan.name}: ` : "";
      return `${name}${leg ? leg[0] : "after the flight"}, ${away.toFixed(0)} m from the site`;
    });
    const utc = new Date(new Date(data.epoch_utc).getTime() + 1000 * time).toISOString().slice(0, 19).replace("T", " ");
    document.getElementById("readout").textContent =
      `t = ${time.toFixed(0)} s | ${utc} UTC | ${said.join(" | ")} | incidence at the ${motion.plans.length > 1 ? "first's " : ""}site ${angle(product(m, motion.site_normal), sunAt(time)).toFixed(1)} deg`;
  }

  // ---- cameras ------------------------------------------------------------------------------

  const eyes = {
    sun: { eye: { x: 1.7, y: 0.02, z: 0.02 }, up: { x: 0, y: 0, z: 1 } },
    north: { eye: { x: 0.02, y: 0, z: 1.8 }, up: { x: 1, y: 0, z: 0 } },
    side: { eye: { x: 0.05, y: -1.8, z: 0.05 }, up: { x: 0, y: 0, z: 1 } },
  };
  const camera = () => scene._fullLayout.scene._scene.getCamera();
  const kept = (layout) => ({ ...layout, scene: { ...layout.scene, camera: camera() } });
  const look = (eye, up, center) => Plotly.relayout(scene, { "scene.camera": { eye, up, center } }).then(later);
  const middle = { x: 0, y: 0, z: 0 };

  /* Where the body is in the units of a camera, in which the box is as long as its aspect ratio. */
  function bodyCentre() {
    const { aspectratio, ...axes } = scene._fullLayout.scene;
    const place = (axis) => {
      const [low, high] = axes[`${axis}axis`].range;
      return -aspectratio[axis] * (low + high) / 2 / (high - low);
    };
    return { x: place("x"), y: place("y"), z: place("z") };
  }

  function turn(azimuth, elevation, factor) {
    const { eye, center } = camera();
    const [x, y, z] = [eye.x - center.x, eye.y - center.y, eye.z - center.z];
    const r = Math.hypot(x, y, z) * factor;
    const a = Math.atan2(y, x) + azimuth;
    const limit = Math.PI / 2 - 0.02;
    const b = Math.min(limit, Math.max(-limit, Math.asin(z / Math.hypot(x, y, z)) + elevation));
    const turned = { x: center.x + r * Math.cos(b) * Math.cos(a), y: center.y + r * Math.cos(b) * Math.sin(a), z: center.z + r * Math.sin(b) };
    return look(turned, { x: 0, y: 0, z: 1 }, center);
  }

  // ---- the other charts ---------------------------------------------------------------------

  const charts = [...document.querySelectorAll("[data-chart]")];
  const ready = new Set();
  const chartOf = (div) => data.charts[Number(div.dataset.chart)];

  async function draw(div) {
    if (ready.has(div)) return;
    ready.add(div);
    const { key, data: traces, layout } = chartOf(div);
    await Plotly.newPlot(div, traces, themed(layout), config(key));
  }

  function now(div) {
    const { key, layout, data: traces } = chartOf(div);
    if (data.cursors.includes(key)) {
      const line = { type: "line", xref: "x", yref: "paper", x0: time, x1: time, y0: 0, y1: 1, line: { color: colours(isDark()).ink, width: 1 } };
      Plotly.relayout(div, { shapes: [...layout.shapes, line] });
    }
    const marked = traces.findIndex((trace) => trace.meta && trace.meta.now !== undefined);
    if (marked >= 0) {
      const p = product(transposed(attitude(time)), craftAt(traces[marked].meta.now, time));
      const update = { x: [[degrees * Math.atan2(p[1], p[0])]], y: [[degrees * Math.atan2(p[2], Math.hypot(p[0], p[1]))]] };
      Plotly.restyle(div, update, [marked]);
    }
  }

  /* Other plans of the same body, drawn in place of these; time, camera and what is shown stay. */
  async function replace(given) {
    const hidden = new Set([...document.querySelectorAll("[data-group]:not(:checked)")].map((box) => box.dataset.group));
    data = given;
    motion = data.scene.motion;
    [start, end] = motion.ends_s;
    bases = basesOf(data.scene.traces);
    data.scene.traces.forEach((trace) => { trace.visible = !hidden.has(trace.meta.group); });
    time = Math.min(Math.max(time, start), end);
    [slider.min, slider.max, slider.value] = [start, end, time].map(String);
    readout();
    await Plotly.react(scene, drawn(), themed(kept(data.scene.layout)), config("view"));
    for (const div of ready) {
      const { key, data: traces, layout } = chartOf(div);
      await Plotly.react(div, traces, themed(layout), config(key));
    }
    later();
  }

  /* What may wait until nothing moves: the time in the charts; later the picture that is printed. */
  let waiting = 0, picturing = 0;
  function later() {
    clearTimeout(waiting);
    clearTimeout(picturing);
    waiting = setTimeout(() => { if (!playing) ready.forEach(now); }, 250);
    picturing = setTimeout(() => { if (!playing) picture(); }, 1500);
  }

  async function picture() {
    const figure = { data: scene.data, layout: themed(kept(data.scene.layout), false) };
    const still = document.getElementById("still");
    still.src = await Plotly.toImage(figure, { format: "png", width: 1000, height: 660 });
    still.dataset.time = String(time);
  }

  // ---- theme and print ----------------------------------------------------------------------

  function restyled() {
    Plotly.relayout(scene, themed(kept(data.scene.layout)));
    ready.forEach((div) => {
      Plotly.relayout(div, themed(chartOf(div).layout));
      now(div);
    });
  }

  function toggled() {
    root.dataset.theme = isDark() ? "light" : "dark";
    restyled();
    later();
  }

  /* All at once: a browser does not wait for what is still to come. */
  function toPrint() {
    printing = true;
    charts.forEach(draw);
    const still = document.getElementById("still");
    const view = scene._fullLayout && scene._fullLayout.scene._scene;
    if (view && !still.getAttribute("src")) still.src = view.toImage("png");
    ready.forEach((div) => Plotly.relayout(div, { ...themed(chartOf(div).layout), width: 690 }));
    document.querySelectorAll("details").forEach((each) => { each.open = true; });
  }
  window.addEventListener("beforeprint", toPrint);
  window.addEventListener("afterprint", () => {
    printing = false;
    ready.forEach((div) => Plotly.relayout(div, { ...themed(chartOf(div).layout), width: null, autosize: true }));
  });

  // ---- controls -----------------------------------------------------------------------------

  async function play() {
    const button = document.getElementById("play");
    playing = !playing;
    button.textContent = playing ? "Pause" : "Play";
    button.setAttribute("aria-pressed", String(playing));
    if (playing && time >= end) time = start;
    let last = performance.now();
    while (playing) {
      await new Promise(requestAnimationFrame);
      const here = performance.now();
      const speed = Number(document.getElementById("speed").value);
      await show(time + speed * Math.min(0.2, (here - last) / 1000));
      last = here;
      if (time >= end && playing) play();
    }
    later();
  }

  let asked = null;
  async function seek(t) {
    const busy = asked !== null;
    asked = t;
    if (busy) return;
    while (asked !== null) {
      const next = asked;
      await show(next);
      if (asked === next) asked = null;
    }
  }

  slider.min = String(start);
  slider.max = String(end);
  slider.addEventListener("input", () => seek(Number(slider.value)));
  slider.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 60, ArrowUp: 60, ArrowLeft: -60, ArrowDown: -60, PageUp: 600, PageDown: -600 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    seek(time + step);
  });
  document.getElementById("play").addEventListener("click", play);
  document.getElementById("theme").addEventListener("click", toggled);
  document.getElementById("closer").addEventListener("click", () => turn(0, 0, 0.8));
  document.getElementById("farther").addEventListener("click", () => turn(0, 0, 1.25));
  document.querySelectorAll("[data-eye]").forEach((button) => button.addEventListener("click", () => {
    if (button.dataset.eye === "near") {
      const body = bodyCentre();
      look({ x: body.x + 0.55, y: body.y - 0.4, z: body.z + 0.25 }, { x: 0, y: 0, z: 1 }, body);
    } else {
      const { eye, up } = eyes[button.dataset.eye];
      look(eye, up, middle);
    }
  }));
  scene.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1], "+": [0, 0, 0.8], "-": [0, 0, 1.25] };
    if (event.key === " ") { event.preventDefault(); play(); }
    if (!turns[event.key]) return;
    event.preventDefault();
    turn(...turns[event.key]);
  });
  document.addEventListener("keydown", (event) => {
    const typing = ["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName);
    if (!typing && event.key.toLowerCase() === "d" && !event.ctrlKey && !event.metaKey && !event.altKey) toggled();
  });
  document.getElementById("groups").addEventListener("change", (event) => {
    const which = data.scene.traces.flatMap((trace, index) => (trace.meta.group === event.target.dataset.group ? [index] : []));
    Plotly.restyle(scene, { visible: event.target.checked }, which).then(() => show(time));
  });
  systemDark.addEventListener("change", () => { if (!root.dataset.theme) restyled(); });

  // A narrow view is seen from farther, so that nothing is cut off at its sides.
  const far = Math.max(1, 1.3 * scene.clientHeight / scene.clientWidth);
  const { eye } = data.scene.layout.scene.camera;
  for (const axis of ["x", "y", "z"]) eye[axis] *= far;

  // ---- first the view, then what is looked at, then the rest ------------------------------------

  readout();
  slider.value = String(time);
  const first = Plotly.newPlot(scene, drawn(), themed(data.scene.layout), config("view")).then(() => {
    performance.mark("first-view");
    const looked = new IntersectionObserver((entries) => entries.forEach((entry) => {
      if (entry.isIntersecting) draw(entry.target);
    }), { rootMargin: "400px" });
    charts.forEach((div) => looked.observe(div));
    later();
  });
  const idle = window.requestIdleCallback || ((work) => setTimeout(work, 50));
  const rest = first.then(() => charts.reduce(
    (before, div) => before.then(() => new Promise((done) => idle(() => done(draw(div))))), Promise.resolve(),
  )).then(() => { performance.mark("all-drawn"); later(); });
  return { first, rest, show, replace, toPrint, craftAt, camera, time: () => time };
})();

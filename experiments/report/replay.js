"use strict";
// Replay of embedded drives: from above, with strip charts, one or two at the same time.
(() => {
  const store = document.getElementById("replay-data");
  const root = document.getElementById("replay");
  if (!store || !root) return;
  const data = JSON.parse(store.textContent);
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  const VIEW_METRES = 50; // of the shorter side, following the vehicle
  const LEAD = "lpv-nmpc";
  const CALM_STEP = 0.5; // s between pictures where motion is not wanted
  const STRIPS = [
    ["lateral", "lateral error", "m", 3],
    ["heading", "heading error", "rad", 3],
    ["yaw", "yaw", "rad", 2],
    ["speed", "speed", "m/s", 2],
    ["steering", "steering angle", "rad", 3],
    ["acceleration", "acceleration", "m/s²", 2],
  ];

  // Data

  const unpack = ([middle, quantum, text], count) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Float64Array.from({ length: count }, (_, k) =>
      middle + quantum * view.getInt16(2 * k, true));
  };
  const opened = new Map();
  const run = (number) => {
    if (number === null) return null;
    if (!opened.has(number)) {
      const { values, ...rest } = data.runs[number];
      for (const [name, packed] of Object.entries(values)) rest[name] = unpack(packed, rest.count);
      opened.set(number, rest);
    }
    return opened.get(number);
  };
  const paths = new Map();
  const reference = (name) => {
    if (!paths.has(name)) {
      const { count, x, y } = data.paths[name];
      paths.set(name, { x: unpack(x, count), y: unpack(y, count) });
    }
    return paths.get(name);
  };
  const place = (drive, time) => {
    const last = drive.count - 1;
    const at = Math.min(Math.max((time / drive.duration) * last, 0), last);
    const k = Math.min(Math.floor(at), last - 1);
    return [k, at - k];
  };
  const value = (drive, name, time) => {
    const [k, part] = place(drive, time);
    return drive[name][k] * (1 - part) + drive[name][k + 1] * part;
  };
  // Position between two moments by Hermite's cubic: moments lie metres apart, bends are round.
  const position = (drive, k, part) => {
    const step = drive.duration / (drive.count - 1);
    const [a, b] = [part * part, part * part * part];
    const weights = [2 * b - 3 * a + 1, b - 2 * a + part, 3 * a - 2 * b, b - a];
    const along = (axis, turn) =>
      weights[0] * drive[axis][k] + weights[2] * drive[axis][k + 1] +
      step * (weights[1] * drive.speed[k] * turn(drive.yaw[k]) +
        weights[3] * drive.speed[k + 1] * turn(drive.yaw[k + 1]));
    return [along("x", Math.cos), along("y", Math.sin)];
  };

  // Elements

  const make = (tag, attributes = {}, ...children) => {
    const element = document.createElement(tag);
    for (const [name, given] of Object.entries(attributes)) element.setAttribute(name, given);
    element.append(...children);
    return element;
  };
  const labelled = (words, element) => make("label", {}, words, element);
  const options = (pairs) =>
    pairs.map(([key, words]) => make("option", { value: key }, String(words)));
  // Drives in groups of one family each; what tells them apart comes first, for narrow screens.
  const words = (drive) => `${drive.agent}, ${drive.conditions}, seed ${drive.seed}`;
  const identity = (drive) => JSON.stringify([words(drive), drive.family]);
  const grouped = (numbers) => {
    const families = Map.groupBy(numbers, (k) => data.runs[k].family);
    return [...families].map(([family, members]) =>
      make("optgroup", { label: family },
        ...options(members.map((k) => [k, words(data.runs[k])]))));
  };
  const pathSelect = make("select", { id: "replay-path" });
  const firstSelect = make("select", { id: "replay-first" });
  const secondSelect = make("select", { id: "replay-second" });
  const playButton = make("button", { type: "button", id: "replay-play" }, "▶ play");
  const viewButton = make("button", { type: "button", id: "replay-follow" }, "follow vehicle");
  const rateSelect = make("select", { id: "replay-rate" });
  const slider = make("input", {
    type: "range", id: "replay-time", min: "0", step: "any", value: "0", "aria-label": "time",
  });
  const clock = make("output", { id: "replay-clock", for: "replay-time" });
  const plan = make("canvas", { class: "view", role: "img", id: "replay-view" });
  const strips = STRIPS.map(([name, words]) =>
    make("canvas", { class: "strip", role: "img", id: `replay-${name}`, "aria-label": `${words} over time` }));
  const readout = make("table");
  root.append(
    make("div", { class: "choose" }, labelled("path", pathSelect),
      labelled("first drive", firstSelect), labelled("second drive", secondSelect)),
    plan,
    make("div", { class: "control" }, playButton, slider, clock, labelled("rate", rateSelect),
      viewButton),
    make("div", { class: "strips" }, ...strips),
    make("div", { class: "wide readout", tabindex: "0" }, readout),
  );
  root.hidden = false;

  // State

  const state = { drives: [], time: 0, end: 1, playing: false, follow: false };
  const colours = {};
  const probe = make("span", { hidden: "" });
  root.append(probe);
  const readColours = () => {
    const names = ["ink", "soft", "line", "page", "c0", "c1"];
    for (const name of names) {
      probe.style.color = `var(--${name})`;
      colours[name] = getComputedStyle(probe).color;
    }
  };
  const own = (k) => colours[`c${k}`];

  const digitsOf = (one, digits) => {
    const text = one.toFixed(digits);
    return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
  };

  // Drawing

  const prepared = (canvas) => {
    const { width, height } = canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== wide || canvas.height !== high) {
      canvas.width = wide;
      canvas.height = high;
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    pen.lineJoin = "round";
    return [pen, width, height];
  };
  const polyline = (pen, count, at) => {
    pen.beginPath();
    for (let k = 0; k < count; k += 1) pen.lineTo(...at(k));
    pen.stroke();
  };
  const box = (pen, length, width) => pen.rect(-length / 2, -width / 2, length, width);
  const vehicle = (pen, drive, time, colour, screen, scale) => {
    const [k, part] = place(drive, time);
    const [x, y] = screen(position(drive, k, part));
    const [length, width, front, rear] = drive.body;
    const size = Math.max(scale, 24 / length);
    pen.save();
    pen.translate(x, y);
    pen.rotate(-value(drive, "yaw", time));
    pen.scale(size, size);
    pen.beginPath();
    pen.rect(-rear - (length - front - rear) / 2, -width / 2, length, width);
    pen.fillStyle = colour;
    pen.globalAlpha = 0.35;
    pen.fill();
    pen.globalAlpha = 1;
    pen.lineWidth = 1.4 / size;
    pen.strokeStyle = colour;
    pen.stroke();
    pen.fillStyle = colours.ink;
    for (const [axle, turn] of [[front, -value(drive, "steering", time)], [-rear, 0]]) {
      for (const side of [-1, 1]) {
        pen.save();
        pen.translate(axle, side * width * 0.42);
        pen.rotate(turn);
        pen.beginPath();
        box(pen, length * 0.17, width * 0.14);
        pen.fill();
        pen.restore();
      }
    }
    pen.restore();
  };
  const drawPlan = () => {
    const [pen, width, height] = prepared(plan);
    const line = reference(pathSelect.value);
    const lead = state.drives[0];
    let [scale, middle] = [1, [0, 0]];
    if (state.follow) {
      scale = Math.min(width, height) / VIEW_METRES;
      middle = position(lead, ...place(lead, state.time));
    } else {
      const ends = [line.x, line.y].map((axis, k) => {
        const name = k ? "y" : "x";
        const every = [axis, ...state.drives.map((drive) => drive[name])];
        return [Math.min(...every.map((one) => Math.min(...one))),
          Math.max(...every.map((one) => Math.max(...one)))];
      });
      scale = Math.min((width - 48) / Math.max(ends[0][1] - ends[0][0], 1),
        (height - 56) / Math.max(ends[1][1] - ends[1][0], 1));
      middle = ends.map(([low, high]) => (low + high) / 2);
    }
    const screen = ([x, y]) =>
      [width / 2 + (x - middle[0]) * scale, height / 2 - (y - middle[1]) * scale];
    pen.strokeStyle = colours.ink;
    pen.globalAlpha = 0.2;
    pen.lineWidth = 6;
    pen.lineCap = "round";
    polyline(pen, line.x.length, (k) => screen([line.x[k], line.y[k]]));
    pen.globalAlpha = 1;
    pen.lineCap = "butt";
    state.drives.forEach((drive, k) => {
      const [until, part] = place(drive, state.time);
      const fine = 4;
      pen.strokeStyle = own(k);
      pen.lineWidth = k ? 1.5 : 2.5;
      polyline(pen, until * fine + 2, (j) => (j > until * fine
        ? screen(position(drive, until, part))
        : screen(position(drive, Math.floor(j / fine), (j % fine) / fine))));
    });
    state.drives.forEach((drive, k) => vehicle(pen, drive, state.time, own(k), screen, scale));
    bar(pen, scale, height);
  };
  const bar = (pen, scale, height) => {
    const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((one) => one * scale > 50) ?? 2000;
    pen.strokeStyle = colours.soft;
    pen.fillStyle = colours.soft;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(12, height - 12);
    pen.lineTo(12 + metres * scale, height - 12);
    pen.stroke();
    pen.fillText(`${metres} m`, 12, height - 18);
  };
  const drawStrip = (canvas, [name, title, unit, digits]) => {
    const [pen, width, height] = prepared(canvas);
    const [top, floor] = [18, height - 6];
    const every = state.drives.map((drive) => drive[name]);
    let low = Math.min(0, ...every.map((one) => Math.min(...one)));
    let high = Math.max(0, ...every.map((one) => Math.max(...one)));
    if (high - low < 1e-9) [low, high] = [low - 1, high + 1];
    const across = (time) => (time / state.end) * (width - 2) + 1;
    const down = (one) => floor - ((one - low) / (high - low)) * (floor - top);
    pen.strokeStyle = colours.line;
    pen.lineWidth = 1;
    polyline(pen, 2, (k) => [k * width, down(0)]);
    pen.fillStyle = colours.soft;
    pen.fillText(`${title} (${unit}): ${digitsOf(low, digits)} to ${digitsOf(high, digits)}`, 2, 11);
    state.drives.forEach((drive, k) => {
      const step = drive.duration / (drive.count - 1);
      if (name === "yaw" && k === 0) {
        // The path's heading at the foot points.
        pen.strokeStyle = colours.ink;
        pen.globalAlpha = 0.2;
        pen.lineWidth = 5;
        polyline(pen, drive.count, (j) => [across(j * step), down(drive.yaw[j] - drive.heading[j])]);
        pen.globalAlpha = 1;
      }
      pen.strokeStyle = own(k);
      pen.lineWidth = k ? 1.1 : 1.6;
      polyline(pen, drive.count, (j) => [across(j * step), down(drive[name][j])]);
    });
    pen.strokeStyle = colours.ink;
    pen.lineWidth = 1;
    polyline(pen, 2, (k) => [across(state.time), k ? height : 14]);
    state.drives.forEach((drive, k) => {
      pen.fillStyle = own(k);
      pen.beginPath();
      pen.arc(across(Math.min(state.time, drive.duration)),
        down(value(drive, name, state.time)), 3.2, 0, 2 * Math.PI);
      pen.fill();
    });
  };
  const cells = [];
  const layTable = () => {
    cells.length = 0;
    const head = make("tr", {}, make("th", { scope: "col" }, "drive"),
      ...STRIPS.map(([, words, unit]) =>
        make("th", { scope: "col", class: "n" }, words, make("small", {}, unit))),
      make("th", { scope: "col" }, "end"));
    const rows = state.drives.map((drive, k) => {
      const mark = make("i", { "aria-hidden": "true" });
      mark.style.background = own(k);
      const values = STRIPS.map(() => make("td", { class: "n" }));
      cells.push(values);
      return make("tr", {}, make("th", { scope: "row" }, mark, `${drive.agent}, ${drive.conditions}`),
        ...values, make("td", {}, `${drive.end}, ${drive.duration.toFixed(1)} s`));
    });
    readout.replaceChildren(make("thead", {}, head), make("tbody", {}, ...rows));
  };
  const draw = () => {
    drawPlan();
    strips.forEach((canvas, k) => drawStrip(canvas, STRIPS[k]));
    cells.forEach((row, k) => row.forEach((cell, j) => {
      const [name, , , digits] = STRIPS[j];
      cell.textContent = digitsOf(value(state.drives[k], name, state.time), digits);
    }));
    const words = `${state.time.toFixed(1)} of ${state.end.toFixed(1)} s`;
    clock.textContent = words;
    slider.setAttribute("aria-valuetext", words);
    plan.setAttribute("aria-label", `${pathSelect.value} from above at ${words}`);
  };
  let waiting = false;
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      draw();
    });
  };

  // Control

  const goTo = (time) => {
    state.time = Math.min(Math.max(time, 0), state.end);
    slider.value = String(state.time);
    redraw();
  };
  const play = (on) => {
    state.playing = on;
    playButton.textContent = on ? "❚❚ pause" : "▶ play";
    playButton.setAttribute("aria-pressed", String(on));
    if (!on) return;
    if (state.time >= state.end) goTo(0);
    let [before, shown] = [performance.now(), 0];
    const tick = (now) => {
      if (!state.playing) return;
      const passed = (now - before) / 1000;
      if (!calm.matches || passed >= CALM_STEP) {
        before = now;
        shown = state.time + passed * Number(rateSelect.value);
        goTo(shown);
        if (shown >= state.end) return play(false);
      }
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  };
  const takeDrives = () => {
    const second = secondSelect.value === "" ? null : Number(secondSelect.value);
    state.drives = [run(Number(firstSelect.value)), run(second)].filter(Boolean);
    state.end = Math.max(...state.drives.map((drive) => drive.duration));
    slider.max = String(state.end);
    // About a tenth of a second, and the last step ends exactly where the drive does.
    slider.step = String(state.end / Math.max(Math.round(10 * state.end), 1));
    layTable();
    goTo(state.time);
  };
  const takePath = () => {
    const own = [...data.runs.keys()].filter((k) => data.runs[k].path === pathSelect.value);
    const alone = secondSelect.value === "" && state.drives.length === 1;
    const before = state.drives.map(identity);
    firstSelect.replaceChildren(...grouped(own));
    secondSelect.replaceChildren(...options([["", "none"]]), ...grouped(own));
    // The same agents go on with the next path; at first the leading one under two conditions.
    const kept = before.map((name) => own.find((k) => identity(data.runs[k]) === name));
    const agent = (k) => data.runs[k].agent;
    const lead = kept[0] ?? own.find((k) => agent(k) === LEAD) ?? own[0];
    const others = own.filter((k) => k !== lead);
    const rival = others.find((k) => agent(k) === agent(lead)) ?? others[0];
    firstSelect.value = String(lead);
    secondSelect.value = alone ? "" : String(kept[1] ?? rival ?? "");
    state.time = 0;
    takeDrives();
  };
  const setFollow = (on) => {
    state.follow = on;
    viewButton.setAttribute("aria-pressed", String(on));
    redraw();
  };
  pathSelect.append(...options(Object.keys(data.paths).map((name) => [name, name])));
  rateSelect.append(...options([1, 2, 5, 10, 20].map((rate) => [rate, `×${rate}`])));
  rateSelect.value = "5";
  pathSelect.addEventListener("change", takePath);
  firstSelect.addEventListener("change", takeDrives);
  secondSelect.addEventListener("change", takeDrives);
  playButton.addEventListener("click", () => play(!state.playing));
  viewButton.addEventListener("click", () => setFollow(!state.follow));
  slider.addEventListener("input", () => {
    play(false);
    goTo(Number(slider.value));
  });
  root.addEventListener("keydown", (event) => {
    if (event.key !== " " || ["BUTTON", "SELECT"].includes(event.target.tagName)) return;
    event.preventDefault();
    play(!state.playing);
  });
  strips.forEach((canvas) => {
    const scrub = (event) => {
      const { left, width } = canvas.getBoundingClientRect();
      play(false);
      goTo(((event.clientX - left) / width) * state.end);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      scrub(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId)) scrub(event);
    });
  });
  const restyle = () => {
    readColours();
    layTable();
    redraw();
  };
  document.addEventListener("colours", restyle);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", restyle);
  new ResizeObserver(redraw).observe(root);
  readColours();
  viewButton.setAttribute("aria-pressed", "false");
  takePath();
})();

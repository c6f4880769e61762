// the arm and the object in motion: sticks and points on a plain canvas, which needs no graphics card
const PALETTE = { measured: ["#6b7783", "#98a5b0"], other: [["#0b6e99", "#4fb3dc"], ["#c2571a", "#f2955a"], ["#5b8c2a", "#9acb62"]] };

class Viewer {
  constructor(box) {
    this.scenes = JSON.parse(box.querySelector("script").textContent);
    this.canvas = box.querySelector("canvas");
    this.slider = box.querySelector("input[type=range]");
    this.output = box.querySelector("output");
    this.button = box.querySelector(".play");
    this.turn = { yaw: -0.9, tilt: 0.32, zoom: 1 };
    this.hidden = new Set();
    this.factor = 1;
    this.speed = 1;
    this.controls(box.querySelector(".bar"));
    this.pointers();
    this.choose(0);
    this.slider.addEventListener("input", () => { this.stop(); this.at(this.from + (this.slider.value / 1000) * (this.to - this.from)); });
    this.button.addEventListener("click", () => (this.playing ? this.stop() : this.play()));
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) { this.stop(); this.at(this.time + (step * (this.to - this.from)) / 200); event.preventDefault(); }
      if (event.key === " ") { this.button.click(); event.preventDefault(); }
    });
    new ResizeObserver(() => this.paint()).observe(this.canvas);
    darkness.addEventListener("change", () => { this.swatches(); this.paint(); });
  }

  controls(bar) {
    const select = (label, entries, chosen, change) => {
      const field = document.createElement("select");
      field.setAttribute("aria-label", label);
      entries.forEach(([text, value]) => field.add(new Option(text, value, value === chosen, value === chosen)));
      field.addEventListener("change", () => change(field.value));
      bar.append(field);
    };
    if (this.scenes.length > 1) select("recording", this.scenes.map((scene, i) => [scene.title, i]), 0, (i) => this.choose(Number(i)));
    select("speed", [["speed ×¼", 0.25], ["speed ×1", 1], ["speed ×4", 4]], 1, (value) => (this.speed = Number(value)));
    const motions = this.scenes.flatMap((scene) => scene.motions);
    const both = motions.some((m) => m.name === "measured") && motions.some((m) => m.name !== "measured" && Object.keys(m.points).length);
    if (both) select("errors", [["errors ×1", 1], ["errors ×5", 5], ["errors ×20", 20]], 1, (value) => { this.factor = Number(value); this.paint(); });
    this.marks = {};
    for (const name of new Set(motions.map((motion) => motion.name))) {
      const label = document.createElement("label"), check = document.createElement("input"), mark = document.createElement("i");
      Object.assign(check, { type: "checkbox", checked: true });
      check.addEventListener("change", () => { this.hidden[check.checked ? "delete" : "add"](name); this.paint(); });
      label.append(check, mark, name);
      bar.append(label);
      this.marks[name] = mark;
    }
    this.swatches();
  }

  color(name) {
    const dark = darkness.matches ? 1 : 0;
    const others = Object.keys(this.marks).filter((entry) => entry !== "measured");
    return name === "measured" ? PALETTE.measured[dark] : PALETTE.other[(others.length - 1 - others.indexOf(name)) % 3][dark];
  }

  swatches() { for (const [name, mark] of Object.entries(this.marks)) mark.style.background = this.color(name); }

  choose(i) {
    this.scene = this.scenes[i];
    this.from = this.scene.t[0];
    this.to = this.scene.t[this.scene.t.length - 1];
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const motion of this.scene.motions) {
      const used = new Set([...motion.sticks.flatMap(([a, b]) => [a, b]), ...Object.values(motion.points)]);
      for (const places of motion.places) for (const k of used) for (let c = 0; c < 3; c++) {
        const x = places[3 * k + c];
        if (x !== null) { low[c] = Math.min(low[c], x / this.scene.scale); high[c] = Math.max(high[c], x / this.scene.scale); }
      }
    }
    this.middle = low.map((x, c) => (x + high[c]) / 2);
    this.reach = Math.max(0.05, Math.hypot(...high.map((x, c) => x - low[c])) / 2);
    this.floor = low[2];
    this.at(this.from);
  }

  at(time) {
    this.time = Math.min(Math.max(time, this.from), this.to);
    this.slider.value = Math.round((1000 * (this.time - this.from)) / (this.to - this.from));
    this.output.textContent = `${this.time.toFixed(2)} of ${this.to.toFixed(2)} s`;
    this.paint();
  }

  play() {
    if (this.time >= this.to) this.time = this.from;
    this.playing = true;
    this.button.textContent = "pause";
    let last = performance.now();
    const tick = (now) => {
      if (!this.playing) return;
      this.at(this.time + (this.speed * (now - last)) / 1000);
      last = now;
      if (this.time >= this.to) this.stop(); else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  stop() { this.playing = false; this.button.textContent = "play"; }

  pointers() {
    const held = new Map();
    const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    this.canvas.addEventListener("pointerdown", (event) => { held.set(event.pointerId, [event.clientX, event.clientY]); this.canvas.setPointerCapture(event.pointerId); });
    for (const end of ["pointerup", "pointercancel"]) this.canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    this.canvas.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const apart = held.size === 2 ? spread() : 0;
      held.set(event.pointerId, [event.clientX, event.clientY]);
      if (held.size === 2) this.turn.zoom *= spread() / apart;
      else {
        this.turn.yaw -= (event.clientX - before[0]) / 150;
        this.turn.tilt = Math.min(1.55, Math.max(-1.55, this.turn.tilt + (event.clientY - before[1]) / 150));
      }
      this.paint();
    });
    this.canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.turn.zoom *= Math.exp(-event.deltaY / 600); this.paint(); }, { passive: false });
  }

  // where a place is on the canvas: x and y in pixels, how near, and pixels a metre there
  eye(width, height) {
    const { yaw, tilt, zoom } = this.turn, [cy, sy, ct, st] = [Math.cos(yaw), Math.sin(yaw), Math.cos(tilt), Math.sin(tilt)];
    const away = 4 * this.reach, size = (0.46 * Math.min(width, height) * zoom * away) / this.reach;
    return (place) => {
      const [x, y, z] = place.map((value, c) => value - this.middle[c]);
      const right = cy * x + sy * y, into = -sy * x + cy * y, up = ct * z + st * into, far = away + ct * into - st * z;
      const scale = size / Math.max(far, 0.05 * away);
      return [width / 2 + scale * right, height / 2 - scale * up, far, scale];
    };
  }

  places(motion) {
    const { t, scale } = this.scene;
    let i = t.findIndex((value) => value > this.time);
    i = i < 0 ? t.length - 1 : Math.max(i, 1);
    const part = (this.time - t[i - 1]) / (t[i] - t[i - 1]), [a, b] = [motion.places[i - 1], motion.places[i]];
    const near = part < 0.5 ? a : b, fresh = motion.fresh ? motion.fresh[part < 0.5 ? i - 1 : i] : null;
    const at = (k) => {
      const found = [0, 1, 2].map((c) => (a[3 * k + c] === null || b[3 * k + c] === null ? near[3 * k + c] : a[3 * k + c] + part * (b[3 * k + c] - a[3 * k + c])));
      return found.includes(null) ? null : found.map((x) => x / scale);
    };
    return Object.assign(at, { fresh });
  }

  paint() {
    const { canvas } = this, ratio = devicePixelRatio || 1, [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !this.scene) return;
    if (canvas.width !== Math.round(width * ratio)) [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const pen = canvas.getContext("2d"), see = this.eye(width, height), style = getComputedStyle(document.documentElement);
    const [ink, pale, card] = ["--ink", "--pale", "--card"].map((name) => style.getPropertyValue(name).trim());
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineCap = "round";
    this.ground(pen, see, pale);
    const shown = this.scene.motions.filter((motion) => !this.hidden.has(motion.name));
    const strokes = [];
    const predicted = shown.filter((motion) => motion.name !== "measured");
    for (const motion of shown) {
      const at = this.places(motion), color = this.color(motion.name), ghost = predicted.length && (motion.name === "measured" || motion !== predicted[predicted.length - 1]);
      for (const [a, b, radius, own] of motion.sticks) {
        const [from, to] = [at(a), at(b)];
        if (!from || !to) continue;
        const [p, q] = [see(from), see(to)], wide = Math.max(own ? 2 : 1.5, (own ? radius : Math.min(radius, 0.08 * this.reach)) * (p[3] + q[3]));
        strokes.push([(p[2] + q[2]) / 2, () => this.stick(pen, p, q, wide, own || ghost ? color : this.softer(color, card), ghost)]);
      }
    }
    const measured = shown.find((motion) => motion.name === "measured");
    if (measured) strokes.push(...this.points(pen, see, measured, predicted, ink));
    else for (const motion of predicted) {
      const at = this.places(motion);
      for (const k of Object.values(motion.points)) { const p = see(at(k)); strokes.push([p[2] - 0.05 * this.reach, () => this.dot(pen, p, 4, this.color(motion.name), true, card)]); }
    }
    strokes.sort((a, b) => b[0] - a[0]).forEach(([, stroke]) => stroke());
  }

  points(pen, see, measured, predicted, ink) {
    const at = this.places(measured), color = darkness.matches ? "#ffd166" : "#b3261e", found = [];
    for (const [i, [name, k]] of Object.entries(measured.points).entries()) {
      const place = at(k);
      if (!place) continue;
      // a point that waits for its next measurement says nothing of now
      if (at.fresh && !at.fresh[i]) {
        const q = see(place);
        found.push([q[2] - 0.25 * this.reach, () => { pen.globalAlpha = 0.35; this.dot(pen, q, 3, color, false, ink); pen.globalAlpha = 1; }]);
        continue;
      }
      let shown = place;
      for (const motion of predicted) {
        if (!(name in motion.points)) continue;
        const from = this.places(motion)(motion.points[name]), p = see(from);
        const to = place.map((x, c) => from[c] + this.factor * (x - from[c])), q = see(to);
        if (motion === predicted[predicted.length - 1]) shown = to;
        found.push([Math.min(p[2], q[2]) - 0.2 * this.reach, () => { this.line(pen, p, q, color, 1.5); this.dot(pen, p, 3.5, this.color(motion.name), true, ink); }]);
      }
      const q = see(shown);
      found.push([q[2] - 0.25 * this.reach, () => this.dot(pen, q, 4, color, false, ink)]);
    }
    return found;
  }

  ground(pen, see, pale) {
    const step = 10 ** Math.floor(Math.log10(this.reach)), half = Math.ceil((1.2 * this.reach) / step);
    const every = half > 8 ? 2 : 1, [x, y] = this.middle.map((value) => Math.round(value / step) * step);
    for (let i = -half; i <= half; i += every) {
      for (const ends of [[[x + i * step, y - half * step], [x + i * step, y + half * step]], [[x - half * step, y + i * step], [x + half * step, y + i * step]]]) {
        const [p, q] = ends.map((place) => see([...place, this.floor]));
        this.line(pen, p, q, pale, 0.8);
      }
    }
  }

  line(pen, p, q, color, wide) {
    pen.strokeStyle = color;
    pen.lineWidth = wide;
    pen.beginPath();
    pen.moveTo(p[0], p[1]);
    pen.lineTo(q[0], q[1]);
    pen.stroke();
  }

  stick(pen, p, q, wide, color, ghost) {
    pen.globalAlpha = ghost ? 0.35 : 1;
    this.line(pen, p, q, color, wide);
    if (!ghost && wide > 5) { pen.globalAlpha = 0.25; this.line(pen, p, q, "#ffffff", wide / 3); }
    pen.globalAlpha = 1;
  }

  dot(pen, p, radius, color, hollow, edge) {
    pen.beginPath();
    pen.arc(p[0], p[1], radius, 0, 2 * Math.PI);
    pen.fillStyle = color;
    pen.fill();
    if (hollow) { pen.strokeStyle = edge; pen.lineWidth = 1.2; pen.stroke(); }
  }

  softer(color, card) {
    const parts = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
    const [a, b] = [parts(color), parts(card)];
    return `rgb(${a.map((x, i) => Math.round(0.45 * x + 0.55 * b[i])).join(",")})`;
  }
}

// a moment can be linked to: report.html#t=1.5
const viewers = [...document.querySelectorAll(".scene")].map((box) => new Viewer(box));
function moment() {
  const found = /(?:^#|&)t=([-+\d.]+)/.exec(location.hash);
  if (!found) return;
  viewers.forEach((viewer) => { viewer.stop(); viewer.at(Number(found[1])); });
}
addEventListener("hashchange", moment);
moment();

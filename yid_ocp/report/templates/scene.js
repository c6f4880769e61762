// the arm and the object in motion: sticks and points on a plain canvas, which needs no graphics card
const PALETTE = { measured: ["#6b7783", "#98a5b0"], points: ["#b3261e", "#ffd166"], other: [["#0b6e99", "#4fb3dc"], ["#c2571a", "#f2955a"], ["#5b8c2a", "#9acb62"]] };

class Viewer {
  constructor(box) {
    const { scenes, meshes } = JSON.parse(box.querySelector("script").textContent);
    this.scenes = scenes;
    this.meshes = meshes;
    this.dressed = Object.keys(meshes).length > 0;
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
    const both = this.scenes.some((scene) => {
      const measured = scene.motions.find((motion) => motion.name === "measured");
      return measured && scene.motions.some((motion) => motion !== measured && Object.keys(motion.points).some((name) => name in measured.points));
    });
    if (both) {
      select("errors", [["errors ×1", 1], ["errors ×5", 5], ["errors ×20", 20]], 1, (value) => { this.factor = Number(value); this.paint(); });
      bar.parentElement.nextElementSibling.append(" A line joins every measured point with its prediction.");
    }
    this.marks = {};
    for (const name of new Set(motions.map((motion) => motion.name))) {
      const label = document.createElement("label"), check = document.createElement("input"), mark = document.createElement("i");
      Object.assign(check, { type: "checkbox", checked: true });
      check.addEventListener("change", () => { this.hidden[check.checked ? "delete" : "add"](name); this.paint(); });
      label.append(check, mark, name);
      bar.append(label);
      this.marks[name] = mark;
    }
    const choice = (text, key) => {
      const label = document.createElement("label"), check = document.createElement("input");
      Object.assign(check, { type: "checkbox", checked: this[key] });
      check.addEventListener("change", () => { this[key] = check.checked; this.paint(); });
      label.append(check, text);
      bar.append(label);
    };
    if (this.dressed) choice("meshes", "dressed");
    const parted = motions.some((motion) => motion.sticks.some((stick) => stick[3]) && motion.sticks.some((stick) => !stick[3]));
    this.following = parted && document.querySelectorAll("section").length === 1; // a page that is only the picture
    if (parted) choice("follow the object", "following");
    const seen = new Set(motions.flatMap((motion) => Object.keys(motion.points)));
    this.named = seen.size > 0 && seen.size <= 6;
    if (seen.size) choice("names of points", "named");
    if ((this.marked = motions.some((motion) => motion.acting.length))) choice("what acts", "marked");
    this.swatches();
  }

  color(name) {
    const dark = darkness.matches ? 1 : 0;
    const others = Object.keys(this.marks).filter((entry) => entry !== "measured");
    return name === "measured" ? PALETTE.measured[dark] : PALETTE.other[(others.length - 1 - others.indexOf(name)) % 3][dark];
  }

  // the recorded arm is a thin line, measured points are what one looks for
  swatches() {
    const dotted = this.scenes.some((scene) => scene.motions.some((motion) => motion.name === "measured" && Object.keys(motion.points).length));
    for (const [name, mark] of Object.entries(this.marks)) mark.style.background = name === "measured" && dotted ? PALETTE.points[darkness.matches ? 1 : 0] : this.color(name);
  }

  choose(i) {
    this.scene = this.scenes[i];
    this.from = this.scene.t[0];
    this.to = this.scene.t[this.scene.t.length - 1];
    const places = [], take = (flat, k) => flat[3 * k] !== null && places.push([0, 1, 2].map((c) => flat[3 * k + c] / this.scene.scale));
    for (const motion of this.scene.motions) {
      const used = new Set([...motion.sticks.flatMap(([a, b]) => [a, b]), ...Object.values(motion.points)]);
      for (const flat of motion.places) for (const k of used) take(flat, k);
    }
    const [still = []] = (this.scene.motions.some((motion) => motion.poses) && this.meshes[""]) || [];
    for (let k = 0; 3 * k < still.length; k++) take(still, k);
    this.whole = this.around(places);
    this.floor = places.reduce((low, place) => Math.min(low, place[2]), Infinity);
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

  // the middle of places, and how far from it they reach
  around(places) {
    const ends = [0, 1, 2].map((c) => places.reduce(([low, high], place) => [Math.min(low, place[c]), Math.max(high, place[c])], [Infinity, -Infinity]));
    const middle = ends.map(([low, high]) => (low + high) / 2);
    return { middle, reach: places.reduce((far, place) => Math.max(far, Math.hypot(...place.map((x, c) => x - middle[c]))), 0.05) };
  }

  // where the object is now; a little of what holds it is seen, too
  near() {
    const places = this.scene.motions.flatMap((motion) => [...motion.sticks.filter((stick) => stick[3]).flatMap(([a, b]) => [a, b]), ...Object.values(motion.points)].map(this.places(motion)));
    const { middle, reach } = this.around(places.filter((place) => place));
    return { middle, reach: 1.3 * reach };
  }

  places(motion) {
    const { scale } = this.scene, [i, part] = this.moment(), [a, b] = [motion.places[i - 1], motion.places[i]];
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
    Object.assign(this, this.following ? this.near() : this.whole, { labels: [] });
    if (canvas.width !== Math.round(width * ratio)) [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const pen = canvas.getContext("2d"), see = this.eye(width, height), style = getComputedStyle(document.documentElement);
    const [ink, pale, card] = ["--ink", "--pale", "--card"].map((name) => style.getPropertyValue(name).trim());
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineCap = "round";
    this.ground(pen, see, pale);
    const shown = this.scene.motions.filter((motion) => !this.hidden.has(motion.name));
    const strokes = [], names = [];
    const clothed = this.dressed && shown.some((motion) => motion.poses);
    const predicted = shown.filter((motion) => motion.name !== "measured");
    for (const motion of shown) {
      const at = this.places(motion), color = this.color(motion.name), ghost = predicted.length && (motion.name === "measured" || motion !== predicted[predicted.length - 1]);
      if (this.dressed && motion.poses) strokes.push(...this.clothes(pen, see, motion, darkness.matches ? [104, 118, 130] : [196, 204, 211]));
      for (const [a, b, radius, own] of motion.sticks) {
        if (!own && this.dressed && motion.poses) continue;
        const [from, to] = [at(a), at(b)];
        if (!from || !to) continue;
        const [p, q] = [see(from), see(to)], wide = clothed && !own ? 3 : Math.max(own ? 2 : 1.5, (own ? radius : Math.min(radius, 0.08 * this.reach)) * (p[3] + q[3]));
        // the recorded arm is seen through the meshes of the predicted one
        const near = clothed && !own ? 10 * this.reach : 0;
        // an earlier model is seen where it differs from the last one: the colors of both would mix to grey
        const behind = ghost && motion.name !== "measured" ? 10 * this.reach : 0;
        strokes.push([(p[2] + q[2]) / 2 - near + behind, () => this.stick(pen, p, q, wide, own || ghost ? color : this.softer(color, card), ghost)]);
      }
    }
    const measured = shown.find((motion) => motion.name === "measured");
    if (measured) strokes.push(...this.points(pen, see, measured, predicted, names, card));
    else for (const motion of predicted) {
      const at = this.places(motion);
      for (const [name, k] of Object.entries(motion.points)) { const p = see(at(k)); strokes.push([p[2] - 0.05 * this.reach, () => { this.dot(pen, p, 4, this.color(motion.name), card); names.push([name, p]); }]); }
    }
    strokes.sort((a, b) => b[0] - a[0]).forEach(([, stroke]) => stroke());
    if (this.named) names.forEach(([name, [x, y]]) => this.write(pen, name, x + 10, y - 6, ink, card));
    if (this.marked) this.acting(pen, see, shown, ink, card);
  }

  // between which two moments the time is, and where
  moment() {
    const { t } = this.scene;
    let i = t.findIndex((value) => value > this.time);
    i = i < 0 ? t.length - 1 : Math.max(i, 1);
    return [i, (this.time - t[i - 1]) / (t[i] - t[i - 1])];
  }

  // triangles of the robot's links: two-sided, lit from where one looks
  clothes(pen, see, motion, rgb) {
    const { scale } = this.scene, [i, part] = this.moment(), found = [];
    const names = Object.keys(this.meshes).filter((name) => name);
    for (const [name, [flat, faces]] of Object.entries(this.meshes)) {
      let move = (x, y, z) => [x / scale, y / scale, z / scale];
      if (name) {
        const k = 7 * names.indexOf(name), [a, b] = [motion.poses[i - 1], motion.poses[i]].map((row) => row.slice(k, k + 7));
        const sign = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
        const pose = a.map((x, c) => x + part * ((c < 3 ? 1 : sign) * b[c] - x)), long = Math.hypot(...pose.slice(3));
        const [px, py, pz] = pose, [qx, qy, qz, qw] = pose.slice(3).map((x) => x / long);
        const m = [
          [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)],
          [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)],
          [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)],
        ];
        move = (x, y, z) => [px, py, pz].map((at, c) => (at + m[c][0] * x + m[c][1] * y + m[c][2] * z) / scale);
      }
      const seen = [];
      for (let v = 0; v < flat.length; v += 3) { const at = move(flat[v], flat[v + 1], flat[v + 2]); seen.push([...see(at), at]); }
      for (let f = 0; f < faces.length; f += 3) {
        const [a, b, c] = [seen[faces[f]], seen[faces[f + 1]], seen[faces[f + 2]]];
        const [u, w] = [b, c].map((corner) => corner[4].map((x, k) => x - a[4][k]));
        const n = [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]], size = Math.hypot(...n) || 1;
        const { yaw, tilt } = this.turn, into = [-Math.sin(yaw) * Math.cos(tilt), Math.cos(yaw) * Math.cos(tilt), -Math.sin(tilt)];
        const light = 0.55 + 0.45 * Math.abs(n[0] * into[0] + n[1] * into[1] + n[2] * into[2]) / size;
        const paint = `rgb(${rgb.map((x) => Math.round(x * light)).join(",")})`;
        found.push([(a[2] + b[2] + c[2]) / 3, () => {
          pen.fillStyle = pen.strokeStyle = paint;
          pen.lineWidth = 0.7;
          pen.beginPath();
          pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.lineTo(c[0], c[1]);
          pen.closePath();
          pen.fill();
          pen.stroke();
        }]);
      }
    }
    return found;
  }

  // effects as marks, unknown forces as arrows and, about a joint, as rings: the largest of a unit is the longest
  acting(pen, see, shown, ink, card) {
    const [i, part] = this.moment(), color = darkness.matches ? "#d9a6f0" : "#7a2f96";
    const elsewhere = [], write = (text, x, y) => this.write(pen, text, x, y, ink, card);
    for (const motion of shown) {
      const at = this.places(motion), largest = {};
      for (const [, , unit, values] of motion.acting) for (const row of values) largest[unit] = Math.max(largest[unit] || 0, Math.hypot(...row));
      for (const [label, k, unit, values] of motion.acting) {
        const row = values[part < 0.5 ? i - 1 : i], place = k < 0 ? null : at(k), size = Math.hypot(...row);
        const text = row.length ? `${label} ${Number(size.toPrecision(2))} ${unit}` : label;
        if (!place) { elsewhere.push(text); continue; }
        const p = see(place), share = row.length ? size / (largest[unit] || 1) : 0;
        if (row.length === 3) {
          const q = see(place.map((x, c) => x + (0.35 * this.reach * row[c]) / (largest[unit] || 1)));
          const [dx, dy] = [q[0] - p[0], q[1] - p[1]], long = Math.hypot(dx, dy) || 1, head = Math.min(9, long / 2);
          this.line(pen, p, q, color, 2.5);
          for (const side of [-0.5, 0.5]) this.line(pen, q, [q[0] - (head * (dx - side * dy)) / long, q[1] - (head * (dy + side * dx)) / long], color, 2.5);
        } else {
          pen.beginPath();
          pen.arc(p[0], p[1], row.length ? 4 + 20 * share : 7, 0, 2 * Math.PI);
          pen.strokeStyle = color;
          pen.lineWidth = 2.5;
          pen.stroke();
        }
        write(text, p[0] + 12, p[1] - 8);
      }
    }
    elsewhere.forEach((text) => write(text, 8, 18));
  }

  points(pen, see, measured, predicted, names, card) {
    const at = this.places(measured), color = PALETTE.points[darkness.matches ? 1 : 0], found = [];
    for (const [i, [name, k]] of Object.entries(measured.points).entries()) {
      const place = at(k);
      if (!place) continue;
      // a point that waits for its next measurement says nothing of now
      if (at.fresh && !at.fresh[i]) {
        const q = see(place);
        found.push([q[2] - 0.25 * this.reach, () => { pen.globalAlpha = 0.35; this.dot(pen, q, 3, color); pen.globalAlpha = 1; }]);
        continue;
      }
      let shown = place;
      for (const motion of predicted) {
        if (!(name in motion.points)) continue;
        const from = this.places(motion)(motion.points[name]), p = see(from);
        const to = place.map((x, c) => from[c] + this.factor * (x - from[c])), q = see(to);
        if (motion === predicted[predicted.length - 1]) shown = to;
        found.push([Math.min(p[2], q[2]) - 0.2 * this.reach, () => { this.line(pen, p, q, color, 1.5); this.dot(pen, p, 6, card, this.color(motion.name)); }]);
      }
      const q = see(shown);
      found.push([q[2] - 0.25 * this.reach, () => { this.dot(pen, q, 4, color); names.push([name, q]); }]);
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

  dot(pen, p, radius, color, edge) {
    pen.beginPath();
    pen.arc(p[0], p[1], radius, 0, 2 * Math.PI);
    pen.fillStyle = color;
    pen.fill();
    if (edge) { pen.strokeStyle = edge; pen.lineWidth = 2; pen.stroke(); }
  }

  // a text at a place, or below the texts that are there
  write(pen, text, x, y, ink, card) {
    pen.font = "12px system-ui, sans-serif";
    const wide = pen.measureText(text).width, left = Math.max(4, Math.min(x, this.canvas.clientWidth - wide - 4));
    while (this.labels.some(([a, b, own]) => left < a + own + 4 && a < left + wide + 4 && Math.abs(b - y) < 15)) y += 15;
    this.labels.push([left, y, wide]);
    pen.globalAlpha = 0.8;
    pen.fillStyle = card;
    pen.fillRect(left - 2, y - 11, wide + 4, 15);
    pen.globalAlpha = 1;
    pen.fillStyle = ink;
    pen.fillText(text, left, y);
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

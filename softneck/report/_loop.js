"use strict";
// One slider moves the outputs and a line in every plot; all values come from `data`.
const at = id => document.getElementById(id);

class Player {
  constructor(data, plots) {
    Object.assign(this, data);
    // The last upright line of each plot stands at the time of the slider.
    this.lines = plots.map(plot => plot.center.filter(one => one.type === "Span" && one.dimension === "height").at(-1));
    this.clock = 0;
    this.before = null;
    this.frame = 0;
  }
  number(value) { return value === null ? "missing" : String(Number(value.toPrecision(3))); }
  sentence(k) {
    const outputs = this.outputs.map(one => `${one.name} ${this.number(one.value[k])} ${one.unit}`
      + (one.reference ? ` (reference ${this.number(one.reference[k])})` : ""));
    const t = this.time[k], now = this.marks.filter(one => one.start <= t && t <= one.end).map(one => one.label);
    return [`t = ${this.number(t)} s`, ...outputs, ...now].join("; ");
  }
  show(k) {
    this.frame = k;
    at("moment").value = k;
    at("now").textContent = this.sentence(k);
    for (const line of this.lines) line.location = this.time[k];
    this.draw(k);
  }
  draw(k) {
    const canvas = at("scene"), pen = canvas.getContext("2d"), scale = devicePixelRatio;
    canvas.width = canvas.clientWidth * scale;
    canvas.height = canvas.clientHeight * scale;
    pen.scale(scale, scale);
    const width = canvas.clientWidth / this.outputs.length, height = canvas.clientHeight;
    this.outputs.forEach((one, i) => {
      pen.save();
      pen.translate(i * width, 0);
      const place = this.bends ? this.arc : this.bar;
      if (one.reference) place.call(this, pen, one, one.reference[k], width, height, "#666666", 2, [5, 4]);
      place.call(this, pen, one, one.value[k], width, height, "#0072B2", 9, []);
      pen.fillStyle = "#1c2530";
      pen.textAlign = "center";
      pen.font = "14px system-ui, sans-serif";
      pen.fillText(`${one.name} [${one.unit}]`, width / 2, height - 6);
      pen.restore();
    });
  }
  // The bend of one output, from the side: an arc of constant curvature with its platform.
  arc(pen, one, value, width, height, colour, thick, dash) {
    if (value === null) return;
    const angle = value * Math.PI / 180, length = 0.62 * height, n = 24, points = [];
    for (let j = 0; j <= n; j++) {
      const a = angle * j / n, s = length * j / n;
      points.push(Math.abs(angle) < 1e-6 ? [0, s] : [length / angle * (1 - Math.cos(a)), length / angle * Math.sin(a)]);
    }
    const [x, y] = points.at(-1), r = 0.16 * height, at = ([u, v]) => [width / 2 + u, height - 30 - v];
    this.stroke(pen, points.map(at), colour, thick, dash);
    this.stroke(pen, [[x - r * Math.cos(angle), y + r * Math.sin(angle)], [x + r * Math.cos(angle), y - r * Math.sin(angle)]]
      .map(at), colour, Math.max(2, thick / 2), dash);
    this.stroke(pen, [[-r, 0], [r, 0]].map(at), "#1c2530", 3, []);
  }
  bar(pen, one, value, width, height, colour, thick, dash) {
    if (value === null) return;
    const y = number => height - 34 - (height - 60) * (number - one.low) / (one.high - one.low), zero = y(Math.min(Math.max(0, one.low), one.high));
    if (dash.length) { this.stroke(pen, [[0.25 * width, y(value)], [0.75 * width, y(value)]], colour, 3, dash); return; }
    pen.fillStyle = colour;
    pen.fillRect(0.38 * width, Math.min(zero, y(value)), 0.24 * width, Math.max(2, Math.abs(zero - y(value))));
    pen.fillStyle = "#1c2530";
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(this.number(one.high), 4, y(one.high) + 4);
    pen.fillText(this.number(one.low), 4, y(one.low) + 4);
  }
  stroke(pen, points, colour, thick, dash) {
    pen.beginPath();
    points.forEach(([x, y], i) => i ? pen.lineTo(x, y) : pen.moveTo(x, y));
    pen.lineWidth = thick;
    pen.strokeStyle = colour;
    pen.setLineDash(dash);
    pen.stroke();
  }
  tick(now) {
    const last = this.time.length - 1;
    this.clock += this.before === null ? 0 : Math.min(0.2, (now - this.before) / 1000) * this.pace;
    this.before = now;
    if (this.clock > this.time[last]) this.clock = 0;
    const k = this.time.findIndex(t => t >= this.clock);
    if (k !== this.frame) this.show(k);
  }
  toggle() {
    if (this.timer) { clearInterval(this.timer); this.timer = null; }
    else {
      [this.clock, this.before] = [this.time[this.frame], null];
      this.timer = setInterval(() => this.tick(performance.now()), 50);
    }
    at("play").textContent = this.timer ? "Pause" : "Play";
  }
  begin() {
    at("moment").max = this.time.length - 1;
    at("moment").addEventListener("input", () => {
      this.clock = this.time[at("moment").valueAsNumber];
      this.show(at("moment").valueAsNumber);
    });
    at("play").addEventListener("click", () => this.toggle());
    addEventListener("resize", () => this.draw(this.frame));
    const first = this.time[0], whole = this.time.at(-1) - first || 1;
    for (const one of this.marks) {
      const mark = document.createElement("i");
      mark.className = one.kind;
      mark.title = one.label;
      mark.style.left = `${100 * (one.start - first) / whole}%`;
      mark.style.width = `${100 * (Math.min(one.end, this.time.at(-1)) - one.start) / whole}%`;
      at("marks").append(mark);
    }
    this.show(0);
  }
}
document.addEventListener("drawn", async () => {
  const data = JSON.parse(new TextDecoder().decode(await unpacked("data")));
  const player = new Player(data, Bokeh.documents[0].roots()[0].children.map(([plot]) => plot));
  player.begin();
  window.player = player;
});

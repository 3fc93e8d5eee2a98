"use strict";
// Two sliders choose the nearest of the judged candidates; spinners move the requirements. All values come from `data`.
const shown = value => Number.isFinite(value) ? String(Number(value.toPrecision(3))) : "unbounded";
const united = (value, unit) => `${shown(value)}${unit ? " " + unit : ""}`;
const at = id => document.getElementById(id);
const SIGNS = { max: "at most", min: "at least", below: "below" };

// Whether a value keeps a requirement, as `ratio` of softneck/tuning/_search.py: one that is no number does not.
function keeps({ bound, limit }, value) {
  if (bound === "min") return value > 0 && value >= limit;
  return bound === "max" ? value <= limit : value < limit;
}
class Tuner {
  constructor(data, plots) {
    Object.assign(this, data, { plots });
    for (const one of this.candidates) {
      one.values = one.values.map(value => value === null ? null : Number(value));
      [one.x, one.y] = [Number(one.x), Number(one.y)];
    }
    this.best = this.candidates.find(one => one.best);
    this.chosen = this.best;
  }
  // "holds", "fails" or "not computed" of each requirement.
  verdicts(one) {
    return this.requirements.map((item, k) => one.unproven[k] ? "fails" : one.values[k] === null ? "not computed"
      : keeps(item, one.values[k]) ? "holds" : "fails");
  }
  broken(one) {
    return this.requirements.filter((_, k) => this.verdicts(one)[k] === "fails");
  }
  phrase(one, item) {
    const value = one.values[this.requirements.indexOf(item)];
    return `${item.name} ${value === null ? "not computed" : united(value, item.unit)}, `
      + `required ${SIGNS[item.bound]} ${united(item.limit, item.unit)}`;
  }
  nearest(speed, caution) {
    const holding = this.candidates.filter(one => !this.broken(one).length);
    const among = at("holding").checked && holding.length ? holding : this.candidates;
    const far = one => (one.speed - speed) ** 2 + (one.caution - caution) ** 2;
    return among.reduce((a, b) => far(b) < far(a) ? b : a);
  }
  sentence(one) {
    const verdicts = this.verdicts(one), broken = this.broken(one);
    const judged = verdicts.filter(word => word !== "not computed").length, open = verdicts.length - judged;
    const which = `Candidate ${one.number} of ${this.candidates.length}, ${one.kind}${one.best ? " (best.npz)" : ""}`;
    const rest = open ? ` Not computed by the search: ${open}.` : "";
    if (!broken.length) return `${which}, keeps all ${judged} requirements that the search computed.${rest}`;
    const list = broken.slice(0, 4).map(item => this.phrase(one, item)).join("; ");
    const more = broken.length > 4 ? `; and ${broken.length - 4} more` : "";
    return `${which}, breaks ${broken.length} of ${judged} requirements: ${list}${more}.${rest}`;
  }
  // What it costs to be 20 % faster: the candidate that breaks least, and what gets worse by more than a twentieth.
  cost(one) {
    const most = 0.8 * one.x, fast = this.candidates.filter(other => other.x <= most);
    const goal = `20 % faster (${this.x_name} at most ${united(most, this.x_unit)})`;
    if (!fast.length) return `${goal}: no judged candidate is.`;
    // Not computed is not kept.
    const missing = other => this.requirements.filter((_, k) => this.verdicts(other)[k] === "not computed");
    const far = other => (this.broken(other).length + missing(other).length) * 1e6 + (other.speed - one.speed) ** 2 + (other.caution - one.caution) ** 2;
    const other = fast.reduce((a, b) => far(b) < far(a) ? b : a);
    const worse = this.requirements.filter((item, k) => {
      const [a, b] = [one.values[k], other.values[k]];
      if (a === null || b === null) return false;
      // What is no number is worse.
      return !(item.bound === "min" ? b >= 0.95 * a : b <= 1.05 * a);
    });
    const list = worse.slice(0, 5).map(item => { const k = this.requirements.indexOf(item);
      return `${item.name} ${united(other.values[k], item.unit)} instead of ${shown(one.values[k])}`; }).join("; ");
    const broken = this.broken(other);
    const ends = broken.length ? ` It breaks: ${broken.map(item => item.name).join("; ")}.` : " It keeps all computed requirements.";
    const open = [...missing(other).map(item => item.name), ...this.elsewhere];
    const unknown = (open.length ? ` Not computed of it: ${open.join("; ")}.` : "")
      + (other.level < one.level ? " It was judged by fewer loops." : "");
    return `${goal}: candidate ${other.number} (${other.kind}, ${united(other.x, this.x_unit)}) costs `
      + `${list || "nothing that is required"}${worse.length > 5 ? "; and more" : ""}.${ends}${unknown}`;
  }
  move() {
    this.choose(this.nearest(at("speed").valueAsNumber, at("caution").valueAsNumber));
  }
  choose(one) {
    this.chosen = one;
    at("speed-says").textContent = `${this.x_name}: ${united(one.x, this.x_unit)}`;
    at("caution-says").textContent = `${this.y_name}: ${united(one.y, this.y_unit)}`;
    const verdict = document.querySelector(".verdict"), fails = this.broken(one).length > 0;
    verdict.textContent = this.sentence(one);
    verdict.className = `verdict ${fails ? "fails" : "holds"}`;
    at("cost").textContent = this.cost(one);
    this.verdicts(one).forEach((word, k) => {
      const value = one.values[k];
      at(`value-${k}`).textContent = value === null ? "-" : united(value, this.requirements[k].unit);
      at(`verdict-${k}`).textContent = word;
      at(`verdict-${k}`).className = word === "not computed" ? "open" : word;
    });
    at("settings").textContent = `${one.kind}: ${one.settings}.`;
    at("file").textContent = one.best ? `Its file is already there: ${this.best_file}. ${this.certified}`
      : `This makes ${one.file} and verifies it; run it in the folder where softneck tune was run.`;
    at("command").textContent = one.command;
    this.draw(one);
  }
  // Curves share sources: each is replaced once, by `draw`.
  set(panel, name, columns) {
    const found = this.plots[panel].renderers.find(one => one.name === name);
    if (!found) return;
    const { glyph, data_source } = found;
    if (!this.pending.has(data_source)) this.pending.set(data_source, {});
    for (const [key, values] of Object.entries(columns)) this.pending.get(data_source)[glyph[key].field] = values;
  }
  draw(one) {
    this.pending = new Map();
    this.fill(one);
    // As a patch: a change of `data` would build the legends anew.
    for (const [source, data] of this.pending) {
      Object.assign(source.data, data);
      source.patching.emit();
    }
  }
  fill(one) {
    const { panels, names } = this, curves = one.curves, time = this.time;
    const good = this.candidates.map(each => !this.broken(each).length);
    const column = keep => this.candidates.map((each, k) => keep(each, k) ? each.y : NaN);
    this.set(panels.front, names.holds, { y: column((_, k) => good[k]) });
    this.set(panels.front, names.fails, { y: column((_, k) => !good[k]) });
    this.set(panels.front, names.chosen, { y: column(each => each === one) });
    for (const [name, item] of [[names.x_limit, this.x_limit], [names.y_limit, this.y_limit]])
      if (item !== null) {
        const limit = this.requirements[item].limit;
        this.set(panels.front, name, name === names.x_limit ? { x: [limit, limit] } : { y: [limit, limit] });
      }
    if (!curves.value) return;
    this.set(panels.step, names.band, { xs: [[...time, ...[...time].reverse()]],
      ys: [[...curves.low, ...[...curves.high].reverse()]] });
    this.set(panels.step, names.value, { y: curves.value });
    this.set(panels.step, names.reference, { y: time.map(() => curves.reference[0]) });
    if (this.overshoot !== null)
      this.set(panels.step, names.overshoot,
        { y: time.map(() => curves.reference[0] * (1 + this.requirements[this.overshoot].limit / 100)) });
    for (const [name, label] of Object.entries(names.motors)) this.set(panels.motors, label, { y: curves[name] });
    if (panels.circle === null || !curves.circle) return;
    const ring = (r, f) => r.map((radius, k) => radius * f(this.angles[k]));
    const both = f => [[...ring(curves.circle_high, f), ...ring(curves.circle_low, f).reverse()]];
    this.set(panels.circle, names.band, { xs: both(Math.cos), ys: both(Math.sin) });
    this.set(panels.circle, names.value, { x: ring(curves.circle, Math.cos), y: ring(curves.circle, Math.sin) });
  }
  // The sliders stand where a candidate is.
  place(one) {
    at("speed").value = one.speed;
    at("caution").value = one.caution;
    this.choose(one);
  }
  begin() {
    // Above the axes, in a layer that is painted without them.
    for (const plot of this.plots) for (const one of plot.renderers) one.level = "overlay";
    for (const id of ["speed", "caution", "holding"]) at(id).addEventListener("input", () => this.move());
    at("best").addEventListener("click", () => { at("holding").checked = false; this.place(this.best); });
    this.requirements.forEach((item, k) => at(`limit-${k}`).addEventListener("input", event => {
      if (!Number.isFinite(event.target.valueAsNumber)) return;
      item.limit = event.target.valueAsNumber;
      if (at("holding").checked) this.move(); else this.choose(this.chosen);
    }));
    at("copy").addEventListener("click", () => {
      getSelection().selectAllChildren(at("command"));
      document.execCommand("copy");
      at("copied").textContent = " copied";
    });
    this.place(this.best);
  }
}
document.addEventListener("drawn", async () => {
  const data = JSON.parse(new TextDecoder().decode(await unpacked("data")));
  const tuner = new Tuner(data, Bokeh.documents[0].roots()[0].children.map(([plot]) => plot));
  tuner.begin();
  window.tuner = tuner;
});

"use strict";
// The budget at a position, between two, or over the detector, at any epoch and magnitude.  The
// variance of each part of the model is a quadratic form of its moments; these are polynomials of time.

class Budget {
  constructor(data) {
    this.data = data;
    const [gx, gy] = data.grid;
    this.gridForms = data.chips.map(({ size }) => {
      const mean = new Float64Array(data.terms.length * (data.terms.length + 1) / 2);
      for (let j = 0; j < gy; j++)
        for (let i = 0; i < gx; i++) {
          const at = (k, n, extent) => n > 1 ? 1 + k / (n - 1) * (extent - 1) : 1;
          this.products(this.basis(size, at(i, gx, size[0]), at(j, gy, size[1])))
            .forEach((v, k) => { mean[k] += v / (gx * gy); });
        }
      return mean;
    });
    this.names = [...data.parts, { name: data.joint }].map(p => p.name);
  }

  /** Legendre products of all terms at a pixel. */
  basis([nx, ny], x, y) {
    const order = Math.max(...this.data.terms.map(([i, j]) => i + j));
    const [px, py] = [(2 * x - nx - 1) / nx, (2 * y - ny - 1) / ny].map(X => {
      const p = [1, X];
      for (let n = 1; n < order; n++) p.push(((2 * n + 1) * X * p[n] - n * p[n - 1]) / (n + 1));
      return p;
    });
    return this.data.terms.map(([i, j]) => px[i] * py[j]);
  }

  /** Products of all pairs: the upper triangle, row by row. */
  products(phi) {
    const out = new Float64Array(phi.length * (phi.length + 1) / 2);
    let k = 0;
    for (let i = 0; i < phi.length; i++) for (let j = i; j < phi.length; j++) out[k++] = phi[i] * phi[j];
    return out;
  }

  /** Moments of all chips and parts at an epoch, by Lagrange's interpolation of the nodes. */
  at(epoch) {
    const { spans } = this.data;
    let span = spans[0];
    for (const one of spans) if (one.nodes.length && epoch >= one.nodes[0]) span = one;
    const t = span.nodes;
    const weights = t.map((a, k) => t.reduce((w, b, m) => m === k ? w : w * (epoch - b) / (a - b), 1));
    const between = nodes => nodes.length === 1 ? nodes[0] : [0, 1].map(axis =>
      nodes[0][axis].map((_, k) => nodes.reduce((sum, node, n) => sum + weights[n] * node[axis][k], 0)));
    this.moved = this.data.products.map(p => this.data.chips.map(({ number: chip }) =>
      between(p.spans[spans.indexOf(span)][chip])));
    this.moments = this.data.chips.map(({ number: chip }) => {
      const out = {};
      for (const [part, nodes] of Object.entries(span.moments[chip]))
        out[part] = between(nodes);
      return out;
    });
  }

  /** What the moments are weighted with: of one pixel, of the difference of two, or over the grid. */
  form(chip, places) {
    if (!places.length) return this.gridForms[chip];
    const { size } = this.data.chips[chip];
    const [a, b] = places.map(([x, y]) => this.basis(size, x, y));
    return this.products(b ? a.map((v, k) => v - b[k]) : a);
  }

  drawn(chip, part, form) {
    return this.moments[chip][part].map(m => {
      let sum = 0;
      for (let k = 0; k < m.length; k++) sum += m[k] * form[k];
      return Math.max(sum, 0);
    });
  }

  local(term, chip, places) {
    const { size, number: name } = this.data.chips[chip];
    return term.sigma[name].map(sigma => places.length
      ? places.reduce((sum, [x, y]) => sum + bilinear(sigma, this.data.grid, size, x, y) ** 2, 0)
      : sigma.reduce((sum, s) => sum + s * s, 0) / sigma.length);
  }

  /** What files differ by: known displacements, squared; in no total. */
  files(chip, places) {
    const { size } = this.data.chips[chip], { grid } = this.data;
    const at = (values, [x, y]) => bilinear(values, grid, size, x, y);
    return this.data.products.map((p, k) => ({ name: p.name, kind: p.kind, source: p.source,
      variance: this.moved[k][chip].map(values => !places.length
        ? values.reduce((sum, s) => sum + s * s, 0) / values.length
        : (at(values, places[0]) - (places[1] ? at(values, places[1]) : 0)) ** 2) }));
  }

  centroid(magnitude) {
    const { mag, log, slope } = this.data.centroid, last = mag.length - 1;
    const m = Math.min(Math.max(magnitude, mag[0]), mag[last]);
    if (last === 0) return log.map(l => Math.exp(2 * l[0]));
    let k = 0;
    while (k < last - 1 && m > mag[k + 1]) k++;
    const h = mag[k + 1] - mag[k], t = (m - mag[k]) / h;
    return log.map((l, axis) => Math.exp(2 * (
      (1 + 2 * t) * (1 - t) ** 2 * l[k] + t * (1 - t) ** 2 * h * slope[axis][k]
      + t * t * (3 - 2 * t) * l[k + 1] + t * t * (t - 1) * h * slope[axis][k + 1])));
  }

  /** Variances [u, v] of terms that are independent of the model. */
  independent(chip, places, magnitude) {
    const times = places.length === 2 ? 2 : 1;
    const out = this.data.local.map(t => ({ ...t, variance: this.local(t, chip, places) }));
    for (const t of this.data.given) {
      const n = t.kind === "random" ? times : 2 - times;  // what all positions share drops out
      out.push({ ...t, variance: t.sigma.map(s => n * s * s) });
    }
    if (magnitude !== null && this.data.centroid)
      out.push({ ...this.data.centroid, variance: this.centroid(magnitude).map(v => times * v) });
    return out;
  }

  /** All terms; over the detector the mean of the chips. */
  terms(chip, places, magnitude) {
    if (!places.length && this.data.chips.length > 1 && chip === null) {
      const all = this.data.chips.map((_, k) => this.terms(k, places, magnitude));
      return all[0].map((t, n) => ({ ...t, variance: [0, 1].map(axis =>
        all.reduce((sum, one) => sum + one[n].variance[axis], 0) / all.length) }));
    }
    const form = this.form(chip || 0, places);
    const parts = this.data.parts.map(p => ({ ...p, variance: this.drawn(chip || 0, p.name, form) }));
    const joint = this.drawn(chip || 0, this.data.joint, form);
    const others = this.independent(chip || 0, places, magnitude);
    const add = (list, axis) => list.reduce((sum, t) => sum + t.variance[axis], 0);
    const shared = [0, 1].map(axis => joint[axis] - add(parts, axis));
    return [...parts, ...others,
      { name: "correlation of the parts", kind: "shared", source: "", variance: shared },
      ...this.files(chip || 0, places),
      { name: "total", kind: "total", source: "", variance: [0, 1].map(a => joint[a] + add(others, a)) }];
  }

  /** Standard deviation of one axis, as the mean of the variances of both. */
  perAxis(chip, places, magnitude, name) {
    if (name !== "total" && this.names.includes(name)) {
      const [u, v] = this.drawn(chip, name, this.form(chip, places));
      return Math.sqrt((u + v) / 2);
    }
    const file = this.files(chip, places).find(p => p.name === name);
    if (file) return Math.sqrt((file.variance[0] + file.variance[1]) / 2);
    const own = this.independent(chip, places, magnitude).filter(t => name === "total" || t.name === name);
    const joint = name === "total" ? this.drawn(chip, this.data.joint, this.form(chip, places)) : [0, 0];
    return Math.sqrt(own.reduce((sum, t) => sum + t.variance[0] + t.variance[1], joint[0] + joint[1]) / 2);
  }
}

function budgetToAsk() {
  const data = read("budget-data"), box = document.getElementById("budget-explorer");
  if (!data || !box) return;
  const budget = new Budget(data), several = data.chips.length > 1;
  const middle = data.chips[0].size.map(s => Math.round((s + 1) / 2));
  const start = () => ({ mode: "rms", chip: 0, a: middle, b: [1, 1], epoch: data.epoch, magnitude: null, map: "total" });
  let state = start();
  const field = (id, label, input) => {
    input.id = `budget-${id}`;
    return make("div", { class: "field", id: `field-${id}` }, make("label", { for: input.id }, label), input);
  };
  const option = ([value, text]) => make("option", { value }, text);
  const mode = make("select", {}, ...[["rms", several ? "rms over all chips" : "rms over the detector"],
    ["one", "one position"], ["two", "difference of two positions"]].map(option));
  const chip = make("select", {}, ...data.chips.map((c, k) => option([k, c.name])));
  const pixel = label => make("input", { type: "number", step: "any", inputmode: "decimal", "aria-label": label });
  const [ax, ay, bx, by] = ["x of A", "y of A", "x of B", "y of B"].map(pixel);
  const pair = (id, label, x, y) => make("div", { class: "field", id: `field-${id}` },
    make("span", { class: "label" }, label), make("span", { class: "pair" }, x, y));
  ax.id = "budget-ax"; ay.id = "budget-ay"; bx.id = "budget-bx"; by.id = "budget-by";
  const slider = make("input", { type: "range", step: "0.05" });
  const year = make("output", { for: "budget-epoch" });
  const mag = make("input", { type: "number", step: "0.1", inputmode: "decimal", placeholder: "none" });
  const map = make("select");
  const reset = make("button", { type: "button" }, "As in the table");
  const controls = make("form", { class: "controls" }, field("mode", "Error of", mode));
  controls.addEventListener("submit", e => e.preventDefault());
  if (several) controls.append(field("chip", "Chip", chip));
  controls.append(pair("a", "Position A (x, y)", ax, ay), pair("b", "Position B (x, y)", bx, by));
  if (data.years) {
    // the budget's own epoch is not on the slider's steps: state keeps it
    [slider.min, slider.max] = [Math.floor(data.years[0] * 20) / 20, data.years[1]];
    const one = field("epoch", "Epoch ", slider);
    one.firstChild.append(year);
    controls.append(one);
  }
  if (data.centroid) controls.append(field("mag", `Magnitude (${number(data.centroid.mag[0], 4)} to ${number(data.centroid.mag.at(-1), 4)})`, mag));
  controls.append(field("map", "Map shows", map), reset);
  const panel = make("div", { class: "panel" });
  const mapbox = make("div", { class: "mapbox" });
  const spoken = make("p", { class: "spoken", "aria-live": "polite" });
  const bar = make("div", { class: "stack", role: "img" });
  const rows = make("tbody");
  const heads = ["Term", "u", "v", "Per axis", "Fraction of variance"];
  const table = make("table", {}, make("thead", {}, make("tr", {}, ...heads.map((h, k) =>
    make("th", k > 0 ? { scope: "col", class: "n" } : { scope: "col" }, h)))), rows);
  panel.append(spoken, bar, make("div", { class: "tablebox" }, table));
  box.append(controls, make("div", { class: "explorer" }, mapbox, panel));
  const maps = new ChipMaps(mapbox, data, { name: "Error per axis", text: v => length(v, data), chosen: (k, x, y) => {
    const second = state.mode === "two" && k === state.chip;
    state = { ...state, chip: k, mode: state.mode === "rms" ? "one" : state.mode, [second ? "b" : "a"]: [x, y] };
    if (state.mode === "two" && !second) state.b = inside(state.b);
    show();
  } });
  maps.hint = "Click on the map to choose a position; move the pointer over it to read it.";
  maps.reading.textContent = maps.hint;

  function inside([x, y]) {
    const { size } = data.chips[state.chip];
    const at = (p, extent) => Math.min(Math.max(p, 0.5), extent + 0.5);
    return [at(x, size[0]), at(y, size[1])];
  }

  function where() {
    const on = several ? ` of ${data.chips[state.chip].name}` : "";
    const at = ([x, y]) => `(${+x.toFixed(2)}, ${+y.toFixed(2)})`;
    if (state.mode === "rms") return several ? "rms over all chips" : "rms over the detector";
    return state.mode === "one" ? `pixel ${at(state.a)}${on}` : `from pixel ${at(state.a)} to ${at(state.b)}${on}`;
  }

  function show() {
    const places = { rms: [], one: [state.a], two: [state.b, state.a] }[state.mode];
    if (data.years) budget.at(state.epoch); else if (!budget.moments) budget.at(0);
    const terms = budget.terms(state.mode === "rms" ? null : state.chip, places, state.magnitude);
    const total = terms.at(-1), sum = total.variance[0] + total.variance[1];
    const share = t => sum > 0 ? (t.variance[0] + t.variance[1]) / sum : 0;
    const tint = k => data.cycle[k % data.cycle.length];
    const signed = v => v < 0 ? `${MINUS}${length(Math.sqrt(-v), data)}` : length(Math.sqrt(v), data);
    const few = terms.filter(t => t.kind !== "shared" || Math.abs(share(t)) >= 5e-4);
    rows.replaceChildren(...few.map(t => {
      const k = terms.indexOf(t), key = ["total", "product"].includes(t.kind) ? [] : [make("span", {
        class: t.kind === "shared" ? "key shared" : "key", style: t.kind === "shared" ? "" : `background:${tint(k)}` })];
      const values = [...t.variance, (t.variance[0] + t.variance[1]) / 2].map(v => make("td", { class: "n" }, signed(v)));
      return make("tr", t.kind === "total" ? { class: "total" } : {}, make("th", { scope: "row", title: [t.kind, t.source].filter(Boolean).join(", ") },
        ...key, t.name), ...values, make("td", { class: "n" },
          t.kind === "product" ? "in no total" : `${plain((100 * share(t)).toFixed(1))}${THIN}%`));
    }));
    const stacked = terms.slice(0, -1).map((t, k) => ({ ...t, k, share: share(t) })).filter(t => t.kind !== "product");
    const longest = stacked.reduce((s, t) => s + Math.max(t.share, 0), 0) || 1;
    const pieces = stacked.filter(t => t.share > 0).map(t => make("span", {
      class: t.kind === "shared" ? "shared" : "", title: `${t.name}: ${(100 * t.share).toFixed(1)} %`,
      style: `width:${100 * t.share / longest}%;${t.kind === "shared" ? "" : `background:${tint(t.k)}`}` }));
    bar.replaceChildren(...pieces, make("i", { style: `left:${100 / longest}%` }));
    bar.setAttribute("aria-label", `Fractions of the total variance: ${stacked.map(t => `${t.name} ${(100 * t.share).toFixed(0)} %`).join(", ")}`);
    const when = data.years ? `, epoch ${state.epoch.toFixed(2)}` : "";
    const star = state.magnitude === null ? "" : `, magnitude ${number(state.magnitude, 4)}`;
    spoken.replaceChildren(`Total, ${where()}${when}${star}: `, make("b", { id: "budget-total" }, length(Math.sqrt(sum / 2), data)), " per axis, 1 \u03c3");
    const label = (place, text) => ({ chip: state.chip, x: place[0], y: place[1], label: text });
    const marks = { rms: [], one: [label(state.a, "A")], two: [label(state.a, "A"), label(state.b, "B")] }[state.mode];
    const known = ["total", ...terms.slice(0, -1).filter(t => t.kind !== "shared").map(t => t.name)];
    if (!known.includes(state.map)) state.map = "total";
    map.replaceChildren(...known.map(n => option([n, n])));
    // two chips have no covariance here: of differences only the chip itself has a map
    const second = state.mode === "two" ? [state.a] : [];
    maps.draw((k, x, y) => second.length && k !== state.chip ? NaN
      : budget.perAxis(k, [[x, y], ...second], state.magnitude, state.map), marks);
    Object.assign(mode, { value: state.mode }); Object.assign(map, { value: state.map });
    chip.value = state.chip;
    [[ax, ay, state.a], [bx, by, state.b]].forEach(([x, y, at]) => { [x.value, y.value] = at; });
    if (data.years) { slider.value = state.epoch; year.textContent = state.epoch.toFixed(2); }
    mag.value = state.magnitude === null ? "" : +state.magnitude.toFixed(3);
    const hide = (id, hidden) => { const e = document.getElementById(id); if (e) e.hidden = hidden; };
    hide("field-a", state.mode === "rms"); hide("field-b", state.mode !== "two"); hide("field-chip", state.mode === "rms");
  }

  const given = (x, y, old) => [x, y].every(i => i.value !== "" && Number.isFinite(+i.value)) ? inside([+x.value, +y.value]) : old;
  const known = m => Math.min(Math.max(m, data.centroid.mag[0]), data.centroid.mag.at(-1));
  const change = () => {
    state = { ...state, mode: mode.value, chip: Number(chip.value), map: map.value,
      magnitude: mag.value === "" || !Number.isFinite(+mag.value) ? null : known(+mag.value) };
    state.a = given(ax, ay, inside(state.a));
    state.b = given(bx, by, inside(state.b));
    show();
  };
  for (const input of [mode, chip, map, ax, ay, bx, by, mag]) input.addEventListener("change", change);
  slider.addEventListener("input", () => { state = { ...state, epoch: +slider.value }; show(); });
  reset.addEventListener("click", () => { state = start(); show(); });
  let before = null;  // what is printed is the budget as quoted
  window.addEventListener("beforeprint", () => { before = state; state = start(); show(); });
  window.addEventListener("afterprint", () => { if (before) { state = before; show(); } });
  box.hidden = false;
  show();
}

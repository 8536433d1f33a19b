"use strict";
// Numbers as the tables have them, maps that a pointer reads, tables that sort.  No library, no
// network: everything is computed from the numbers in this page.

const MINUS = "\u2212", THIN = "\u202f", MISSING = "\u2013";
const SUPERSCRIPT = "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079";

const plain = text => text.replace("-", MINUS);

/** A number to some significant digits; powers of ten where it is very small or large. */
function number(x, digits = 3) {
  if (!Number.isFinite(x)) return MISSING;
  if (x === 0) return "0";
  const [mantissa, power] = x.toExponential(digits - 1).split("e");
  const exponent = Number(power);
  if (exponent >= -4 && exponent < Math.max(digits, 6))
    return plain(x.toFixed(Math.max(0, digits - 1 - exponent)));
  const raised = [...String(exponent)].map(c => c === "-" ? "\u207b" : SUPERSCRIPT[c]).join("");
  return `${plain(mantissa)}${THIN}\u00d7${THIN}10${raised}`;
}

/** A length with its unit, and in mas beside it where the size of a pixel is known. */
function length(x, data, unit = data.unit) {
  if (unit === "pix") {
    const text = `${number(x)}${THIN}pix`;
    return data.scale_mas === null ? text : `${text} (${length(x * data.scale_mas, data, "mas")})`;
  }
  const steps = data.ladders[unit];
  const own = steps.find(step => step[0] === 1) || steps[0];
  const [factor, name] = x === 0 ? own
    : steps.find(step => x * step[0] >= 0.0999) || steps[steps.length - 1];
  return `${number(x * factor)}${THIN}${name}`;
}

/** Data of the page; what is missing in a list of numbers is no zero. */
const read = id => {
  const found = document.getElementById(id);
  const missing = (key, value) => value === null && /^\d+$/.test(key) ? NaN : value;
  return found ? JSON.parse(found.textContent, missing) : null;
};

const SVG = "http://www.w3.org/2000/svg";

/** An element of a drawing with its attributes. */
function drawn(tag, attributes, text = "") {
  const element = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.textContent = text;
  return element;
}

/** An element with its attributes and what is in it. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "style") element.style.cssText = value;  // the page's policy knows no such attribute
    else element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

function colour(colors, share) {
  const at = Math.min(Math.max(share, 0), 1) * (colors.length - 1);
  const k = Math.min(Math.floor(at), colors.length - 2), f = at - k;
  const channel = (c, i) => parseInt(c.slice(1 + 2 * i, 3 + 2 * i), 16);
  return [0, 1, 2].map(i => (1 - f) * channel(colors[k], i) + f * channel(colors[k + 1], i));
}

/** Between the points of a grid that reaches from the centre of the first pixel to the last one's. */
function bilinear(values, [nx, ny], size, x, y) {
  const place = (p, n, extent) => {
    const t = extent > 1 ? Math.min(Math.max((p - 1) / (extent - 1), 0), 1) * (n - 1) : 0;
    const k = Math.max(0, Math.min(Math.floor(t), n - 2));
    return [k, Math.min(k + 1, n - 1), t - k];
  };
  const [i, i1, f] = place(x, nx, size[0]), [j, j1, g] = place(y, ny, size[1]);
  return (1 - g) * ((1 - f) * values[j * nx + i] + f * values[j * nx + i1])
    + g * ((1 - f) * values[j1 * nx + i] + f * values[j1 * nx + i1]);
}

/** Maps of all chips at one scale, with a colour bar, marks, and a line that reads the pointer. */
class ChipMaps {
  constructor(box, data, { name, text, chosen = null }) {
    Object.assign(this, { data, text, chosen, name, marks: [] });
    const widest = Math.max(...data.chips.map(c => c.size[0]));
    const columns = 1 + Math.max(...data.chips.map(c => c.place[1]));
    this.grid = make("div", { class: "chips", style: `grid-template-columns:repeat(${columns},1fr)` });
    this.canvases = data.chips.map((chip, k) => {
      const wide = Math.max(8, Math.round(72 * chip.size[0] / widest));
      const canvas = make("canvas", {
        width: wide, height: Math.max(4, Math.round(wide * chip.size[1] / chip.size[0])),
        role: "img", "aria-label": `${name}, ${chip.name}`,
      });
      const marks = drawn("svg", {
        viewBox: `0.5 0.5 ${chip.size[0]} ${chip.size[1]}`, "aria-hidden": "true",
      });
      const frame = make("div", { class: "chip" }, canvas, marks);
      if (chosen) {
        frame.tabIndex = 0;
        frame.setAttribute("role", "application");
        frame.setAttribute("aria-label",
          `Map of ${chip.name}: arrow keys move the position, with shift by more`);
        frame.addEventListener("click", e => chosen(k, ...this.pixel(frame, chip, e)));
        frame.addEventListener("keydown", e => this.key(e, k));
      }
      frame.addEventListener("pointermove", e => this.hover(k, ...this.pixel(frame, chip, e)));
      frame.addEventListener("pointerleave", () => { this.reading.textContent = this.hint; });
      const title = data.chips.length > 1 ? [make("span", { class: "chipname" }, chip.name)] : [];
      const cell = make("div", { style: `grid-row:${chip.place[0] + 1};grid-column:${chip.place[1] + 1}` },
        ...title, frame);
      cell.style.width = `${100 * chip.size[0] / widest}%`;
      this.grid.append(cell);
      return { canvas, marks, chip };
    });
    this.hint = "x runs to the right and y up; move the pointer over the map to read it.";
    this.bar = make("div", { class: "colourbar", "aria-hidden": "true" });
    this.low = make("span"); this.high = make("span");
    const stops = data.colors.map((c, k) => `${c} ${100 * k / (data.colors.length - 1)}%`);
    this.bar.style.background = `linear-gradient(to right, ${stops.join(", ")})`;
    this.reading = make("p", { class: "reading" }, this.hint);
    box.append(this.grid, make("div", { class: "scale" }, this.low, this.bar, this.high), this.reading);
  }

  pixel(frame, chip, event) {
    const box = frame.getBoundingClientRect();
    const at = (p, extent) => Math.min(Math.max(Math.round(p), 1), Math.floor(extent));
    return [at(0.5 + (event.clientX - box.left) / box.width * chip.size[0], chip.size[0]),
      at(0.5 + (box.bottom - event.clientY) / box.height * chip.size[1], chip.size[1])];
  }

  key(event, k) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step) return;
    event.preventDefault();
    const { size } = this.data.chips[k], far = (event.shiftKey ? 0.1 : 0.01) * Math.max(...size);
    const last = this.marks.filter(m => m.chip === k).pop();
    const [x, y] = last ? [last.x, last.y] : size.map(s => (s + 1) / 2);
    const at = (p, extent) => Math.min(Math.max(Math.round(p), 1), Math.floor(extent));
    this.chosen(k, at(x + far * step[0], size[0]), at(y + far * step[1], size[1]));
  }

  hover(k, x, y) {
    const { name } = this.data.chips[k];
    const where = this.data.chips.length > 1 ? ` of ${name}` : "";
    this.reading.textContent = `pixel (${x}, ${y})${where}: ${this.text(this.value(k, x, y))}`;
  }

  /** Draw a function of chip, x and y from the first to the last pixel, where maps are extreme. */
  draw(value, marks = []) {
    Object.assign(this, { value, marks });
    const fields = this.canvases.map(({ canvas, chip }, k) => {
      const out = new Float64Array(canvas.width * canvas.height);
      for (let row = 0; row < canvas.height; row++)
        for (let column = 0; column < canvas.width; column++)
          out[row * canvas.width + column] = value(k,
            1 + column / (canvas.width - 1) * (chip.size[0] - 1),
            1 + (1 - row / (canvas.height - 1)) * (chip.size[1] - 1));
      return out;
    });
    const every = fields.map(f => f.filter(Number.isFinite).reduce((a, b) => [Math.min(a[0], b), Math.max(a[1], b)], [Infinity, -Infinity]));
    const low = Math.min(...every.map(e => e[0])), high = Math.max(...every.map(e => e[1]));
    this.low.textContent = this.text(low);
    this.high.textContent = this.text(high);
    this.canvases.forEach(({ canvas, marks: svg, chip }, k) => {
      const context = canvas.getContext("2d"), image = context.createImageData(canvas.width, canvas.height);
      fields[k].forEach((v, n) => {
        const share = high > low ? (v - low) / (high - low) : 0;
        image.data.set(Number.isNaN(v) ? [213, 219, 225, 255] : [...colour(this.data.colors, share), 255], 4 * n);
      });
      context.putImageData(image, 0, 0);
      const radius = 0.018 * Math.max(...chip.size);
      svg.replaceChildren(...this.marks.filter(m => m.chip === k).flatMap(m => {
        const place = { cx: m.x, cy: chip.size[1] + 1 - m.y, r: radius };
        return [drawn("circle", { ...place, class: "halo" }), drawn("circle", { ...place, class: "ring" }),
          drawn("text", { x: place.cx, y: place.cy - 1.5 * radius, "font-size": 2.6 * radius }, m.label)];
      }));
    });
  }
}

function mapsToRead() {
  const data = read("map-data"), box = document.getElementById("map-reader");
  if (!data || !box) return;
  const select = make("select", { id: "map-layer" });
  data.layers.forEach((layer, k) => select.append(make("option", { value: k }, layer.name)));
  const layer = () => data.layers[select.value];
  box.append(make("p", { class: "controls" }, make("label", { for: "map-layer" }, "Map "), select));
  const maps = new ChipMaps(box, data, {
    name: "Map", text: v => layer().unit ? length(v, data, layer().unit) : number(v, layer().digits),
  });
  const show = () => maps.draw((k, x, y) => {
    const { values, shape } = layer().maps[k];
    return bilinear(values, shape, data.chips[k].size, x, y);
  });
  select.addEventListener("change", show);
  box.hidden = false;
  show();
}

const UNITS = { "\u00b5as": 1e-3, mas: 1, arcsec: 1e3, deg: 3.6e6 };
/** What a cell of numbers is worth: its first number, with its power of ten and angles in mas. */
function worth(text) {
  const tidy = text.replace(/[\u202f\u00a0 ](?=\d{3}(\D|$))/g, "").replaceAll(MINUS, "-");
  const found = tidy.match(/(-?\d+(?:\.\d+)?)(?:\s*\u00d7\s*10([\u207b\u2070\u00b9\u00b2\u00b3\u2074-\u2079]+))?\s*(\u00b5as|mas|arcsec|deg)?/);
  if (!found) return /\u221e/.test(tidy) ? (tidy.includes("-") ? -Infinity : Infinity) : NaN;
  const power = [...(found[2] || "")].map(c => c === "\u207b" ? "-" : SUPERSCRIPT.indexOf(c)).join("");
  return Number(found[1]) * 10 ** Number(power || 0) * (UNITS[found[3]] || 1);
}

function sortable(table) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = make("button", { type: "button", class: "sort" }, ...head.childNodes);
    head.replaceChildren(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => {
      const falling = head.getAttribute("aria-sort") === "ascending";
      heads.forEach(h => h.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", falling ? "descending" : "ascending");
      const numeric = head.classList.contains("n") || "key" in body.rows[0].cells[column].dataset;
      const text = cell => cell.dataset.key ?? cell.textContent;
      const key = row => numeric ? worth(text(row.cells[column])) : text(row.cells[column]);
      const order = (a, b) => numeric ? a - b : a.localeCompare(b, "en", { numeric: true });
      const rows = [...body.rows].map(row => ({ row, key: key(row), last: row.classList.contains("total") }));
      rows.sort((a, b) => {
        if (a.last !== b.last) return a.last ? 1 : -1;  // the total, and what is missing, stay below
        if (Number.isNaN(a.key) || Number.isNaN(b.key)) return Number.isNaN(a.key) - Number.isNaN(b.key);
        return falling ? order(b.key, a.key) : order(a.key, b.key);
      });
      body.append(...rows.map(r => r.row));
    });
  });
}

/** Texts of a table's cells, row by row, with plain signs and spaces. */
function textsOf(table) {
  const tidy = cell => [...cell.childNodes].filter(n => !(n.classList && n.classList.contains("help")))
    .map(n => n.textContent).join("").replaceAll(MINUS, "-").replace(/[\u202f\u00a0\s]+/g, " ").trim();
  return [...table.rows].map(row => [...row.cells].map(tidy));
}

function csvOf(rows) {
  const quoted = text => /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  return rows.map(row => row.map(quoted).join(",")).join("\r\n") + "\r\n";
}

const TEX = {
  "\\": "\\textbackslash{}", "&": "\\&", "%": "\\%", "$": "\\$", "#": "\\#", "_": "\\_", "{": "\\{", "}": "\\}",
  "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "\u00d7": "$\\times$", "\u00b1": "$\\pm$", "\u03c3": "$\\sigma$",
  "\u03c7": "$\\chi$", "\u00b2": "$^2$", "\u00b5": "$\\mu$", "\u221e": "$\\infty$", "\u2013": "--", "\u2020": "\\dag{}",
};
function latexOf(rows, caption) {
  const plainText = text => [...text.replace(/^-(?=[\d.])/, "\u0000")].map(c => c === "\u0000" ? "$-$" : TEX[c] ?? c).join("")
    .replace(/[\u207b\u2070\u00b9\u00b3\u2074-\u2079]+/g, found => `$^{${[...found].map(c => c === "\u207b" ? "-" : SUPERSCRIPT.indexOf(c)).join("")}}$`);
  const width = Math.max(...rows.map(row => row.length));
  const lines = rows.map(row => row.length === 1 && width > 1
    ? `\\multicolumn{${width}}{l}{${plainText(row[0])}}` : row.map(plainText).join(" & "));
  return ["\\begin{table}", `\\caption{${plainText(caption)}}`, `\\begin{tabular}{${"l".repeat(width)}}`, "\\hline",
    ...lines.map((line, k) => `${line} \\\\${k === 0 ? " \\hline" : ""}`), "\\hline", "\\end{tabular}", "\\end{table}", ""].join("\n");
}

function saved(text, name, type) {
  const link = make("a", { download: name, href: URL.createObjectURL(new Blob([text], { type })) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** In the caption of a table: its content as CSV and as LaTeX. */
function downloads(table) {
  const caption = table.caption ? textsOf({ rows: [{ cells: [table.caption] }] })[0][0] : "table";
  const name = caption.toLowerCase().replace(/[^a-z0-9]+/g, "_").replace(/^_+|_+$/g, "").slice(0, 60) || "table";
  const button = (label, act) => {
    const one = make("button", { type: "button", "aria-label": `${caption} as ${label}` }, label);
    one.addEventListener("click", act);
    return one;
  };
  const box = make("span", { class: "get" },
    button("CSV", () => saved(csvOf(textsOf(table)), `${name}.csv`, "text/csv")),
    button("LaTeX", () => saved(latexOf(textsOf(table), caption), `${name}.tex`, "text/x-tex")));
  table.caption.append(box);
}

document.addEventListener("DOMContentLoaded", () => {
  mapsToRead();
  budgetToAsk();
  for (const table of document.querySelectorAll("table.grid"))
    if (table.tHead && table.tBodies.length === 1 && table.tBodies[0].rows.length > 1) sortable(table);
  for (const table of document.querySelectorAll("main .tablebox > table"))
    if (table.caption) downloads(table);
});

// Distributions by group and the scatter of two traits, as SVG in the colours of the page.
const SHAPES = [
  "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0", "M-3.5 -3.5h7v7h-7z", "M0 -4.8l4.6 8h-9.2z", "M0 4.8l4.6 -8h-9.2z",
  "M-1.5 -4.5h3v3h3v3h-3v3h-3v-3h-3v-3h3z", "M-4.5 -2h9v4h-9z", "M-2 -4.5h4v9h-4z",
];
const DIAMOND = "M0 -5.5l5.5 5.5l-5.5 5.5l-5.5 -5.5z", MOST_GROUPS = 60, MOST_BARS = 300, ROW = 52, TOP = 6;

function drawn(tag, attributes, ...content) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...content);
  return made;
}

/** A scale from numbers to pixels that leaves room at both ends, and round numbers on it. */
function scaled(values, from, to, wanted = 6) {
  let low = Infinity, high = -Infinity;
  for (const value of values) [low, high] = [Math.min(low, value), Math.max(high, value)];
  const half = low === high ? Math.abs(low) * 0.05 || 0.5 : (high - low) * 0.04;
  [low, high] = [low - half, high + half];
  const rough = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const ticks = [];
  for (let tick = Math.ceil(low / step); tick * step <= high; tick++) ticks.push(Number((tick * step).toPrecision(12)));
  return { at: (value) => from + ((value - low) / (high - low)) * (to - from), ticks };
}

/** A mark that tells its object and opens its report. */
function mark(data, index, path, attributes, x, y, told) {
  const point = drawn("path", { d: path, transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})`, ...attributes });
  point.append(drawn("title", {}, `${nameOf(data, index)}: ${told}`));
  return data.reports[index] ? drawn("a", { href: data.reports[index], tabindex: "-1" }, point) : point;
}

const pictureOf = (width, height, label) =>
  drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });

const inside = (value, low, high) => Math.min(high, Math.max(low, value));

/** The line of ± one standard deviation; none for what spreads over the object's surface, which is no uncertainty. */
function bars(column, sd, at, stroke) {
  if (!(sd > 0) || column.group === "index") return [];
  const [[x1, y1], [x2, y2]] = [at(-sd), at(sd)];
  return [drawn("line", { class: "bar", stroke, x1, x2, y1, y2 })];
}

/** A strip of points a group, with its median and middle half. */
function drawDistribution(place, data, at, groups, sides) {
  const column = data.columns[at], width = Math.max(280, place.clientWidth);
  const strips = [...groups].map(([name, rows]) => [name, rows.filter((index) => data.rows[index][at] !== null)])
    .filter(([, rows]) => rows.length);
  const some = strips.slice(0, MOST_GROUPS);
  if (!some.length) return place.replaceChildren(element("p", { className: "missing" }, "No object shown has this trait."));
  const across = scaled(some.flatMap(([, rows]) => rows.map((index) => data.rows[index][at])), 8, width - 8);
  const height = TOP + some.length * ROW + 34, svg = pictureOf(width, height, `Distribution of ${headed(column)}`);
  for (const tick of across.ticks) {
    svg.append(drawn("line", { class: "grid", x1: across.at(tick), x2: across.at(tick), y1: TOP, y2: height - 30 }));
    svg.append(drawn("text", { class: "tick", x: across.at(tick), y: height - 18, "text-anchor": "middle" }, String(tick)));
  }
  svg.append(drawn("text", { class: "tick", x: width / 2, y: height - 3, "text-anchor": "middle" }, headed(column)));
  some.forEach(([name, rows], number) => {
    const top = TOP + number * ROW, middle = top + 33, sorted = ascending(rows.map((index) => data.rows[index][at]));
    const [low, half, high] = [0.25, 0.5, 0.75].map((fraction) => across.at(quantile(sorted, fraction)));
    svg.append(drawn("rect", { class: "box", x: low, width: Math.max(1, high - low), y: middle - 12, height: 24, rx: 3 }));
    rows.forEach((index, order) => {
      const value = data.rows[index][at], off = (((order * 0.618) % 1) - 0.5) * 20, odd = sides.get(index);
      const look = { class: odd ? "point odd" : "point", ...(odd ? {} : { fill: "var(--s0)" }) };
      const told = `${shownValue(column, value, data.rows[index])} ${column.unit}`;
      svg.append(mark(data, index, odd ? DIAMOND : SHAPES[0], look, across.at(value), middle + off, told));
    });
    svg.append(drawn("line", { class: "median", x1: half, x2: half, y1: middle - 14, y2: middle + 14 }));
    const told = `${name} (${rows.length}, median ${shownNumber(quantile(sorted, 0.5))})`;
    svg.append(drawn("text", { x: 8, y: top + 13 }, told));
  });
  place.replaceChildren(svg);
  if (strips.length > some.length) {
    place.append(element("p", { className: "missing" }, `The first ${some.length} of ${strips.length} groups; filter to see others.`));
  }
}

/** Two traits of each object; the largest groups have colours and shapes of their own. */
function drawScatter(place, legend, data, [x, y], groups, sidesOfBoth) {
  const width = Math.max(280, place.clientWidth), height = Math.round(Math.min(560, width * 0.7)), left = 58;
  const there = (index) => data.rows[index][x] !== null && data.rows[index][y] !== null;
  const known = [...groups].map(([name, rows]) => [name, rows.filter(there)]).filter(([, rows]) => rows.length);
  legend.replaceChildren();
  if (!known.length) return place.replaceChildren(element("p", { className: "missing" }, "No object shown has both traits."));
  const largest = [...known].sort(([, a], [, b]) => b.length - a.length).slice(0, SHAPES.length).map(([name]) => name);
  const all = known.flatMap(([, rows]) => rows), [columnX, columnY] = [data.columns[x], data.columns[y]];
  const across = scaled(all.map((index) => data.rows[index][x]), left, width - 8);
  const up = scaled(all.map((index) => data.rows[index][y]), height - 40, 14);
  const svg = pictureOf(width, height, `${headed(columnY)} over ${headed(columnX)}`);
  for (const tick of across.ticks) {
    svg.append(drawn("line", { class: "grid", x1: across.at(tick), x2: across.at(tick), y1: 14, y2: height - 40 }));
    svg.append(drawn("text", { class: "tick", x: across.at(tick), y: height - 24, "text-anchor": "middle" }, String(tick)));
  }
  for (const tick of up.ticks) {
    svg.append(drawn("line", { class: "grid", x1: left, x2: width - 8, y1: up.at(tick), y2: up.at(tick) }));
    svg.append(drawn("text", { class: "tick", x: left - 6, y: up.at(tick) + 4, "text-anchor": "end" }, String(tick)));
  }
  svg.append(drawn("text", { class: "tick", x: (left + width) / 2, y: height - 6, "text-anchor": "middle" }, headed(columnX)));
  svg.append(drawn("text", { class: "tick", x: 2, y: 10 }, headed(columnY)));
  const spreadOf = (column, row) => (column.spread === null ? null : row[column.spread]);
  for (const [name, rows] of known) {
    const rank = known.length > SHAPES.length ? largest.slice(0, -1).indexOf(name) : known.findIndex(([one]) => one === name);
    const [path, colour] = rank < 0 ? [SHAPES[0], "var(--faint)"] : [SHAPES[rank], `var(--s${rank})`];
    for (const index of rows) {
      const row = data.rows[index], [px, py] = [across.at(row[x]), up.at(row[y])];
      const [sx, sy] = [spreadOf(columnX, row), spreadOf(columnY, row)];
      if (all.length <= MOST_BARS) svg.append(...bars(columnX, sx, (d) => [inside(across.at(row[x] + d), left, width - 8), py], colour),
        ...bars(columnY, sy, (d) => [px, inside(up.at(row[y] + d), 14, height - 40)], colour));
      const told = `${shownValue(columnX, row[x], row)} ${columnX.unit}, ${shownValue(columnY, row[y], row)} ${columnY.unit}`;
      svg.append(mark(data, index, path, { class: "point", fill: colour }, px, py, told));
      if (sidesOfBoth.some((sides) => sides.has(index))) svg.append(drawn("circle", { class: "ring", cx: px, cy: py, r: 8 }));
    }
    if (rank >= 0 && known.length > 1) {
      const sign = drawn("svg", { viewBox: "-6 -6 12 12", "aria-hidden": "true" }, drawn("path", { d: path, fill: colour }));
      legend.append(element("li", {}, sign, `${name} (${rows.length})`));
    }
  }
  if (known.length > SHAPES.length) {
    const others = known.filter(([name]) => largest.slice(0, -1).indexOf(name) < 0).length;
    const sign = drawn("svg", { viewBox: "-6 -6 12 12", "aria-hidden": "true" }, drawn("path", { d: SHAPES[0], fill: "var(--faint)" }));
    legend.append(element("li", {}, sign, `${others} other groups`));
  }
  place.replaceChildren(svg);
}

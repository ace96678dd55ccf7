// The controls beside the object: what is shown, how it is turned, which spectra were picked.

const MOST_PICKED = 6;
const SVG = "http://www.w3.org/2000/svg";
const TURN_PER_SECOND = 0.35;

function element(name, attributes, text, namespace) {
  const made = namespace ? document.createElementNS(namespace, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

function seriesColour(index) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--s${index}`).trim();
}

function rgbOf(colour) {
  return [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16) / 255);
}

function download(blob, name) {
  const href = URL.createObjectURL(blob);
  element("a", { href, download: name }).click();
  URL.revokeObjectURL(href);
}

function start(root, cloud) {
  const canvas = root.querySelector("canvas"), form = root.querySelector("form"), fields = form.elements;
  const legend = root.querySelector(".legend"), pickedBox = root.querySelector(".picked");
  const missed = root.querySelector(".missed");
  const renderer = new Renderer(canvas, cloud), picked = [];

  function showBar(low, high, words) {
    const stops = Array.from({ length: 9 }, (_, i) => {
      const at = 3 * Math.min(255, 32 * i);
      return `rgb(${cloud.colours.subarray(at, at + 3).join(" ")})`;
    });
    const bar = element("div", { class: "bar", style: `background: linear-gradient(to right, ${stops.join(", ")})` });
    const ends = element("div", { class: "ends" });
    for (const text of [low.toPrecision(3), words, high.toPrecision(3)]) ends.append(element("span", {}, text));
    legend.replaceChildren(bar, ends);
  }

  function show() {
    const wavelength = `${cloud.wavelengths[Number(fields.band.value)].toFixed(1)} nm`;
    form.querySelector("output").textContent = wavelength;
    const [kind, index] = fields.shown.value.split(" ");
    if (kind === "composite") {
      const chosen = cloud.composites[index], bands = chosen.nm.map((nm) => cloud.band(cloud.nearestBand(nm)));
      const white = Math.max(...bands.map((values) => quantile(values, 0.99)));
      legend.replaceChildren(element("span", {}, `${chosen.nm.join(", ")} nm as red, green, blue: ${chosen.tells}; `
        + `full brightness is reflectance ${white.toPrecision(2)}`));
      renderer.colour(cloud.composed(bands, white));
    } else if (kind === "band") {
      const band = Number(fields.band.value), values = cloud.band(band), high = quantile(values, 0.99);
      showBar(0, high, `reflectance at ${wavelength}`);
      renderer.colour(cloud.mapped(values, 0, high));
    } else {
      const { name, tells, drawn } = cloud.scalars[index];
      showBar(...drawn, `${name} (${tells})`);
      renderer.colour(cloud.mapped(cloud.scalar(index), ...drawn));
    }
  }

  function drawSpectra() {
    renderer.marks = picked.map(({ point, series }) => ({ point, rgb: rgbOf(seriesColour(series)) }));
    renderer.draw();
    if (!picked.length) { pickedBox.replaceChildren(); return; }
    const [width, height, left, bottom, top] = [340, 210, 40, 34, 8];
    const [first, last] = [cloud.wavelengths[0], cloud.wavelengths.at(-1)];
    const highest = Math.max(0.05, ...picked.flatMap(({ spectrum }) => spectrum)) * 1.05;
    const step = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1].find((size) => highest / size <= 6) ?? 2;
    const x = (nm) => left + ((nm - first) / (last - first || 1)) * (width - left - 16);
    const y = (value) => height - bottom - (value / highest) * (height - bottom - top);
    const svg = element("svg", { class: "chart", role: "img", viewBox: `0 0 ${width} ${height}`,
      "aria-label": "Reflectance over wavelength of the points that were clicked" }, undefined, SVG);
    const add = (name, attributes, text) => svg.append(element(name, attributes, text, SVG));
    for (let value = 0; value <= highest; value += step) {
      add("path", { stroke: "var(--rule)", d: `M${left} ${y(value)}H${width - 16}` });
      add("text", { x: left - 5, y: y(value) + 4, "text-anchor": "end" }, value.toFixed(2));
    }
    for (let nm = Math.ceil(first / 100) * 100; nm <= last; nm += last - first > 450 ? 200 : 100) {
      add("text", { x: x(nm), y: height - 19, "text-anchor": "middle" }, String(nm));
    }
    add("text", { x: (left + width) / 2, y: height - 4, "text-anchor": "middle" }, "wavelength (nm)");
    for (const { spectrum, series } of picked) {
      const d = spectrum.map((v, i) => `${i ? "L" : "M"}${x(cloud.wavelengths[i]).toFixed(1)} ${y(v).toFixed(1)}`);
      add("path", { class: "line", stroke: `var(--s${series})`, d: d.join("") });
    }
    const list = element("ul", {});
    for (const { point, series } of picked) {
      const [a, b, c] = cloud.millimetres(point).map((mm) => mm.toFixed(1));
      const item = element("li", {}, `x ${a}, y ${b}, z ${c} mm`);
      item.prepend(element("span", { class: "dot", style: `background: ${seriesColour(series)}` }));
      list.append(item);
    }
    pickedBox.replaceChildren(element("strong", {}, "Reflectance"), svg, list);
  }

  function pick(x, y) {
    const point = renderer.pick(x, y);
    missed.hidden = point >= 0;
    if (point < 0) return;
    if (picked.length === MOST_PICKED) picked.shift();
    const taken = new Set(picked.map(({ series }) => series));
    const series = Array.from({ length: MOST_PICKED }, (_, i) => i).find((i) => !taken.has(i));
    picked.push({ point, series, spectrum: cloud.spectrum(point) });
    drawSpectra();
  }

  function save() {
    const names = picked.map(({ point }) => cloud.millimetres(point).map((mm) => mm.toFixed(1)).join(" "));
    const rows = cloud.wavelengths.map((nm, i) => [nm, ...picked.map(({ spectrum }) => spectrum[i].toFixed(5))]);
    const csv = [["wavelength_nm", ...names.map((name) => `reflectance at ${name} mm`)], ...rows];
    download(new Blob([csv.map((row) => row.join(",")).join("\n") + "\n"]), "spectra.csv");
  }

  function turn(right, up) {
    renderer.azimuth -= right;
    renderer.elevation = Math.min(1.55, Math.max(-1.55, renderer.elevation + up));
    renderer.draw();
  }

  function move(right, up) {
    renderer.shift = [renderer.shift[0] + right, renderer.shift[1] + up];
    renderer.draw();
  }

  function zoom(factor) {
    renderer.distance = Math.min(12, Math.max(1.3, renderer.distance * factor));
    renderer.draw();
  }

  const groups = [
    ["Composites", "composite", cloud.composites.map(({ name }) => name)],
    ["One band", "band", ["reflectance at a wavelength"]],
    ["Indices and columns", "scalar", cloud.scalars.map(({ name }) => name)],
  ];
  for (const [label, kind, names] of groups.filter(([, , names]) => names.length)) {
    const group = element("optgroup", { label });
    names.forEach((name, i) => group.append(element("option", { value: `${kind} ${i}` }, name)));
    fields.shown.append(group);
  }
  fields.band.max = cloud.wavelengths.length - 1;
  fields.band.value = cloud.nearestBand(700);
  fields.turning.checked = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  fields.shown.addEventListener("change", show);
  fields.band.addEventListener("input", () => { fields.shown.value = "band 0"; show(); });
  fields.shading.addEventListener("change", () => { renderer.shading = fields.shading.checked ? 1 : 0; renderer.draw(); });
  fields.size.addEventListener("input", () => { renderer.size = Number(fields.size.value); renderer.draw(); });
  fields.clear.addEventListener("click", () => { picked.length = 0; drawSpectra(); });
  fields.save.addEventListener("click", () => { if (picked.length) save(); });
  fields.picture.addEventListener("click", () => canvas.toBlob((blob) => download(blob, "object.png")));

  const pointers = new Map();
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    travelled = pointers.size > 1 ? Infinity : 0;
    fields.turning.checked = false;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY], [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const other = [...pointers].find(([id]) => id !== event.pointerId);
    pointers.set(event.pointerId, now);
    travelled += Math.hypot(dx, dy);
    if (other) {
      const apart = ([a, b]) => Math.max(1, Math.hypot(a - other[1][0], b - other[1][1]));
      zoom(apart(before) / apart(now));
    } else if (event.shiftKey) {
      const scale = (2 * renderer.distance * Math.tan(FIELD_OF_VIEW / 2)) / canvas.clientHeight;
      move(dx * scale, -dy * scale);
    } else if (travelled > 3) turn(0.01 * dx, 0.01 * dy);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (pointers.delete(event.pointerId) && travelled <= 3) pick(event.offsetX, event.offsetY);
  });
  canvas.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const moves = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const by = moves[event.key];
    if (by && event.shiftKey) move(by[0], by[1]);
    else if (by) turn(...by);
    else if ("+-".includes(event.key)) zoom(event.key === "+" ? 0.9 : 1.1);
    else if (event.key === "Enter" || event.key === " ") pick(canvas.clientWidth / 2, canvas.clientHeight / 2);
    else return;
    fields.turning.checked = false;
    event.preventDefault();
  });
  window.addEventListener("resize", () => renderer.draw());
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawSpectra);

  let last;
  function tick(time) {
    if (fields.turning.checked && !document.hidden) {
      renderer.azimuth += TURN_PER_SECOND * Math.min(0.1, (time - (last ?? time)) / 1000);
      renderer.draw();
    }
    last = time;
    requestAnimationFrame(tick);
  }
  show();
  requestAnimationFrame(tick);
}

// On a narrow screen the cards are closed but for the first: the findings tell which to open.
if (window.matchMedia("(max-width: 48rem)").matches) {
  for (const card of document.querySelectorAll("section:not(#object) > .card")) card.open = false;
}
document.querySelector("header").addEventListener("click", ({ target }) => {
  const card = target.hash && document.querySelector(`${target.hash} > .card`);
  if (card) card.open = true;
});
const root = document.getElementById("cloud");
if (root) {
  try {
    start(root, new Cloud(JSON.parse(document.getElementById("cloud-data").textContent)));
    root.dataset.state = "ready";
  } catch (error) {
    root.dataset.state = "failed";
    root.replaceChildren(element("p", { class: "missing" }, `The object cannot be shown in 3D: ${error.message}.`));
  }
}

// Spectra in one chart: lines over wavelength, with their standard deviation where they have one.

const SVG = "http://www.w3.org/2000/svg";

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

/** A chart of `curves`, each with its `series` (colour), `spectrum` and, of a region, `sd`. */
function spectraChart(wavelengths, curves) {
  const [width, height, left, bottom, top] = [340, 210, 40, 34, 8];
  const [first, last] = [wavelengths[0], wavelengths.at(-1)];
  const reach = curves.flatMap(({ spectrum, sd }) => spectrum.map((value, i) => value + (sd ? sd[i] : 0)));
  const highest = Math.max(0.05, ...reach) * 1.05;
  const step = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1].find((size) => highest / size <= 6) ?? 2;
  const x = (nm) => left + ((nm - first) / (last - first || 1)) * (width - left - 16);
  const y = (value) => height - bottom - (Math.max(value, 0) / highest) * (height - bottom - top);
  const svg = element("svg", { class: "chart", role: "img", viewBox: `0 0 ${width} ${height}`,
    "aria-label": "Reflectance over wavelength of the points and regions that were chosen" }, undefined, SVG);
  const add = (name, attributes, text) => svg.append(element(name, attributes, text, SVG));
  for (let value = 0; value <= highest; value += step) {
    add("path", { stroke: "var(--rule)", d: `M${left} ${y(value)}H${width - 16}` });
    add("text", { x: left - 5, y: y(value) + 4, "text-anchor": "end" }, value.toFixed(2));
  }
  for (let nm = Math.ceil(first / 100) * 100; nm <= last; nm += last - first > 450 ? 200 : 100) {
    add("text", { x: x(nm), y: height - 19, "text-anchor": "middle" }, String(nm));
  }
  add("text", { x: (left + width) / 2, y: height - 4, "text-anchor": "middle" }, "wavelength (nm)");
  const places = (values) => values.map((v, i) => `${x(wavelengths[i]).toFixed(1)} ${y(v).toFixed(1)}`);
  for (const { spectrum, sd, series } of curves) {
    if (sd) {
      const above = places(spectrum.map((v, i) => v + sd[i])), below = places(spectrum.map((v, i) => v - sd[i]));
      const d = `M${[...above, ...below.reverse()].join("L")}Z`;
      add("path", { class: "spread", fill: `var(--s${series})`, d });
    }
    add("path", { class: "line", stroke: `var(--s${series})`, d: `M${places(spectrum).join("L")}` });
    if (spectrum.length === 1) add("circle", { fill: `var(--s${series})`, cx: x(first), cy: y(spectrum[0]), r: 3 });
  }
  return svg;
}

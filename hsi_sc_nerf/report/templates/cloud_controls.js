// The controls beside the object: what is shown, how it is turned, which spectra were picked.

const MOST_CURVES = 6;
const MOST_UNDONE = 50;
const TOO_MANY = `There are ${MOST_CURVES} regions, which is the most; delete one.`;
const CLASS_COLOURS = 7;
const TURN_PER_SECOND = 0.35;

function download(blob, name) {
  const href = URL.createObjectURL(blob);
  element("a", { href, download: name }).click();
  URL.revokeObjectURL(href);
}

function start(root, cloud) {
  const canvas = root.querySelector("canvas"), form = root.querySelector("form"), fields = form.elements;
  const legend = root.querySelector(".legend"), pickedBox = root.querySelector(".picked");
  const scale = root.querySelector(".scale");
  const told = root.querySelector(".told"), list = root.querySelector(".regions");
  const renderer = new Renderer(canvas, cloud), picked = [], regions = [], past = [];
  let current = null, unsaved = false;

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

  /** A dot a class, and its area on the page's points. */
  function showClasses({ name, classes, rest, areas_cm2 }) {
    const items = [...classes, rest].map((label, i) => {
      const item = element("span", { class: "class" }, `${label} ${areas_cm2[i].toFixed(2)} cm²`);
      item.prepend(i < classes.length ? dot(i % CLASS_COLOURS) : element("span", { class: "dot unknown" }));
      return item;
    });
    legend.replaceChildren(element("span", {}, `Most probable class by ${name}: `), ...items);
  }

  /** Colours of the points, with the regions in their own. */
  function paint(rgb) {
    for (const { points, series } of regions) {
      const own = rgbOf(seriesColour(series)).map((part) => 255 * part);
      for (const point of points) own.forEach((part, i) => { rgb[3 * point + i] = 0.4 * rgb[3 * point + i] + 0.6 * part; });
    }
    renderer.colour(rgb);
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
      paint(cloud.composed(bands, white));
    } else if (kind === "band") {
      const band = Number(fields.band.value), values = cloud.band(band), high = quantile(values, 0.99);
      showBar(0, high, `reflectance at ${wavelength}`);
      paint(cloud.mapped(values, 0, high));
    } else if (kind === "classes") {
      const one = cloud.classifiers[index], colours = one.classes.map((_, i) => rgbOf(seriesColour(i % CLASS_COLOURS)));
      showClasses(one);
      paint(cloud.classed(one, colours));
    } else {
      const { name, tells, drawn } = cloud.scalars[index], values = cloud.scalar(index);
      showBar(...drawn, `${name} (${tells})${values.some(Number.isNaN) ? "; grey: no value" : ""}`);
      paint(cloud.mapped(values, ...drawn));
    }
  }

  function drawSpectra() {
    renderer.marks = picked.map(({ point, series }) => ({ point, rgb: rgbOf(seriesColour(series)) }));
    renderer.draw();
    pickedBox.replaceChildren();
    if (!picked.length && !regions.length) return;
    const places = element("ul", {});
    for (const { point, series } of picked) {
      const [a, b, c] = cloud.millimetres(point).map((mm) => mm.toFixed(1));
      const item = element("li", {}, `x ${a}, y ${b}, z ${c} mm`);
      item.prepend(dot(series));
      places.append(item);
    }
    const words = regions.length ? "Reflectance, with the standard deviation within a region" : "Reflectance";
    pickedBox.append(element("strong", {}, words), spectraChart(cloud.wavelengths, [...regions, ...picked]), places);
  }

  function dot(series) {
    return element("span", { class: "dot", style: `background: ${seriesColour(series)}` });
  }

  /** A colour that no other curve has; the oldest picked point gives way. -1: all are taken by regions. */
  function freeSeries() {
    if (picked.length + regions.length >= MOST_CURVES && !picked.shift()) return -1;
    const taken = new Set([...picked, ...regions].map(({ series }) => series));
    return Array.from({ length: MOST_CURVES }, (_, i) => i).find((i) => !taken.has(i));
  }

  function say(words) {
    told.textContent = words;
    told.hidden = !words;
  }

  function pick(x, y) {
    const point = renderer.pick(x, y);
    say(point >= 0 ? "" : "No point of the object is there.");
    if (point < 0) return;
    const series = freeSeries();
    if (series < 0) { say(`There are ${MOST_CURVES} regions; delete one to see the spectrum of a point.`); return; }
    picked.push({ point, series, spectrum: cloud.spectrum(point) });
    drawSpectra();
  }

  /** Called before the regions change. */
  function remember() {
    past.push({ before: regions.map((region) => ({ ...region })), at: regions.indexOf(current), deed: fields.deed.value });
    if (past.length > MOST_UNDONE) past.shift();
    unsaved = true;
  }

  function undo() {
    say(past.length ? "" : "There is nothing to undo.");
    if (!past.length) return;
    const { before, at, deed } = past.pop();
    regions.splice(0, regions.length, ...before);
    [current, fields.deed.value] = [regions[at], deed];
    // A deleted region's colour may be a point's by now.
    const taken = new Set(regions.map(({ series }) => series));
    picked.splice(0, picked.length, ...picked.filter(({ series }) => !taken.has(series)));
    picked.splice(0, picked.length + regions.length - MOST_CURVES);
    showRegions();
  }

  function addRegion(name, points) {
    regions.push(current = { name: ownName(name), points, series: freeSeries(), ...measured(cloud, points) });
    showRegions();
  }

  /** The name for a region, with a number where another one has it: `traits` measures no two of one name. */
  function ownName(name, region) {
    const taken = ["whole surface", ...regions.filter((one) => one !== region).map((one) => one.name)];
    for (let number = 1; ; number++) {
      const own = number > 1 ? `${name} ${number}` : name;
      if (!taken.includes(own)) return own;
    }
  }

  function showRegions() {
    if (!regions.includes(current)) current = regions.at(-1);
    list.replaceChildren(...regions.map((region) => {
      const item = element("li", {}), chosen = element("input", { type: "radio", name: "current",
        "aria-label": `Change ${region.name}` });
      chosen.checked = region === current;
      chosen.addEventListener("change", () => { current = region; });
      const name = element("input", { value: region.name, "aria-label": "Name of the region" });
      const away = element("button", { type: "button", "aria-label": `Delete ${region.name}` }, "Delete");
      // The list stays as it is, so that the focus does, too.
      name.addEventListener("change", () => {
        const wanted = ownName(name.value.trim() || region.name, region);
        if (wanted !== region.name) remember();
        name.value = region.name = wanted;
        chosen.setAttribute("aria-label", `Change ${region.name}`);
        away.setAttribute("aria-label", `Delete ${region.name}`);
      });
      away.addEventListener("click", () => {
        const at = regions.indexOf(region);
        remember();
        regions.splice(at, 1);
        showRegions();
        (list.children[Math.min(at, regions.length - 1)]?.querySelector("button") ?? fields.drawing).focus();
      });
      item.append(chosen, dot(region.series), name, away, element("p", {}, wordsOf(region)));
      return item;
    }));
    show();
    drawSpectra();
  }

  /** What was drawn becomes a region, or is added or moved to the chosen one, or taken from it. */
  function closeLine(line, radius, taking) {
    const brush = radius !== null, deed = taking ? "take" : fields.deed.value;
    const found = new Set(pointsWhere(renderer, (place) => (
      brush ? distanceFrom(place, line) <= radius : inside(place, line))));
    say(found.size ? "" : `The line goes ${brush ? "over" : "round"} no point of the object.`);
    if (!found.size) return;
    if (deed === "take" && !current) { say("There is no region to take from."); return; }
    const another = deed === "new" || !current;
    if (another && regions.length >= MOST_CURVES) { say(TOO_MANY); return; }
    remember();
    if (another) {
      let number = regions.length + 1;
      while (regions.some(({ name }) => name === `region ${number}`)) number++;
      addRegion(`region ${number}`, [...found]);
      if (brush) fields.deed.value = "add";
      return;
    }
    for (const region of deed === "move" ? [...regions] : [current]) {
      const before = region.points.length, kept = region.points.filter((point) => !found.has(point));
      const points = region === current && deed !== "take" ? [...kept, ...found] : kept;
      if (!points.length) regions.splice(regions.indexOf(region), 1);
      else if (region === current || points.length < before) Object.assign(region, { points }, measured(cloud, points));
    }
    showRegions();
  }

  async function load(file) {
    try {
      const found = regionsOf(cloud, await file.text()), room = MOST_CURVES - regions.length;
      say(found.length > room ? TOO_MANY : "");
      if (room) remember();
      for (const { name, points } of found.slice(0, room)) addRegion(name.trim(), points);
    } catch (error) { say(`${file.name}: ${error.message}.`); }
  }

  /** A bar of a round length, as long as it is at the depth of the object's centre. */
  function drawScale() {
    const mm = renderer.pixels() / (cloud.reach * 1e3), longest = (0.3 * canvas.clientWidth) / mm;
    const power = 10 ** Math.floor(Math.log10(longest)), length = [5, 2, 1].find((n) => n * power <= longest) * power;
    // A part of the picture's width, so that it stays right where the page is printed on a narrower sheet.
    scale.style.width = `${(100 * length * mm) / canvas.clientWidth}%`;
    scale.textContent = `${Number(length.toPrecision(1))} mm`;
  }

  const groups = [
    ["Composites", "composite", cloud.composites.map(({ name }) => name)],
    ["One band", "band", ["reflectance at a wavelength"]],
    ["Classes", "classes", cloud.classifiers.map(({ name }) => name)],
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
  fields.undo.addEventListener("click", undo);
  fields.clear.addEventListener("click", () => { picked.length = 0; drawSpectra(); });
  fields.save.addEventListener("click", () => {
    if (picked.length || regions.length) download(new Blob([spectraFile(cloud, regions, picked)]), "spectra.csv");
    else say("Click on the object or draw a region first.");
  });
  fields.saveRegions.addEventListener("click", () => {
    if (!regions.length) { say("There is no region yet; tick \"draw regions\" and draw one."); return; }
    download(new Blob([regionFile(cloud, regions)]), "regions.json");
    unsaved = false;
  });
  fields.openRegions.addEventListener("click", () => fields.loadRegions.click());
  fields.loadRegions.addEventListener("change", () => {
    if (fields.loadRegions.files.length) load(fields.loadRegions.files[0]);
    fields.loadRegions.value = "";
  });
  fields.theme.addEventListener("change", () => {
    document.documentElement.dataset.theme = fields.theme.value;
    showRegions();
  });
  fields.picture.addEventListener("click", () => (
    pictureOf(canvas, scale, legend, cloud.colours).toBlob((blob) => download(blob, "object.png"))));

  listen(root, renderer, fields, { pick, closeLine, undo });
  window.addEventListener("beforeunload", (event) => { if (unsaved && regions.length) event.preventDefault(); });
  renderer.onDraw = drawScale;
  window.addEventListener("resize", () => renderer.draw());
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", showRegions);

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

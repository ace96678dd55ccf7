// Regions that are drawn on the object: their points, their means, and the file that `traits --roi-file` reads.

const FRONT_DEPTH = 0.05;
const FILE_KIND = "hsi-sc-nerf regions";
const FAR_SPACINGS = 2;

/** Whether a place lies inside a closed line, by the number of its sides to the right (even-odd rule). */
function inside([x, y], line) {
  let within = false;
  for (let i = 0, j = line.length - 1; i < line.length; j = i++) {
    const [[xi, yi], [xj, yj]] = [line[i], line[j]];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) within = !within;
  }
  return within;
}

/** Distance of a place from a line, which may be a single place. */
function distanceFrom([x, y], line) {
  return Math.min(...line.map(([x1, y1], i) => {
    const [x0, y0] = line[Math.max(0, i - 1)], [dx, dy] = [x1 - x0, y1 - y0];
    const along = Math.min(1, Math.max(0, ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy || 1)));
    return Math.hypot(x - x0 - along * dx, y - y0 - along * dy);
  }));
}

/** The points whose places on the canvas (CSS pixels) are chosen: those that the camera sees, and none behind them. */
function pointsWhere(renderer, chosen) {
  const seen = renderer.project(), cell = Math.max(4, 2 * renderer.spacingPx()), nearest = new Map();
  const cellOf = ({ x, y }) => `${Math.floor(x / cell)} ${Math.floor(y / cell)}`;
  for (const one of seen) nearest.set(cellOf(one), Math.min(nearest.get(cellOf(one)) ?? Infinity, one.depth));
  const front = seen.filter((one) => one.depth <= nearest.get(cellOf(one)) + FRONT_DEPTH);
  return front.filter(({ x, y }) => chosen([x, y])).map(({ point }) => point);
}

/** Mean and standard deviation of the values that there are, and what part of all these are. */
function meanAndSd(values) {
  const finite = values.filter(Number.isFinite), mean = finite.reduce((a, b) => a + b, 0) / finite.length;
  const sd = Math.sqrt(finite.reduce((a, b) => a + (b - mean) ** 2, 0) / finite.length);
  return [mean, sd, finite.length / values.length];
}

/** Area (cm²), also of each class, mean spectrum with its standard deviation, and the mean of each index. */
function measured(cloud, points) {
  const indices = cloud.scalars.map((scalar, i) => ({ ...scalar, i })).filter(({ index }) => index);
  return {
    area_cm2: points.reduce((area, point) => area + cloud.areas_cm2[point], 0),
    ...cloud.meanAndSd(points),
    areas: cloud.classifiers.map((one) => ({ ...one, areas_cm2: cloud.classAreas(one, points) })),
    indices: indices.map(({ name, unit, i }) => {
      const values = cloud.scalar(i);
      return { name, unit, mean_sd: meanAndSd(Array.from(points, (point) => values[point])) };
    }),
  };
}

/** Size, indices and areas of classes of a region, in words. */
function wordsOf({ points, area_cm2, indices, areas }) {
  const means = indices.map(({ name, unit, mean_sd: [mean, sd, part] }) => {
    if (!part) return `${name} no value`;
    const of = part < 0.995 ? ` (of ${Math.max(1, Math.round(100 * part))} % of the points, the others have no value)` : "";
    return `${name} ${mean.toPrecision(3)} ± ${sd.toPrecision(2)} ${unit}`.trim() + of;
  });
  const classed = areas.map(({ name, classes, rest, areas_cm2 }) => `${name}: ${[...classes, rest].map((label, i) => (
    `${label} ${areas_cm2[i].toFixed(2)} cm²`)).join(", ")}`);
  return [`${points.length} points, ${area_cm2.toPrecision(3)} cm²`, ...means, ...classed].join("; ");
}

/** A line a band: mean and standard deviation of each region, then the picked points' reflectance. */
function spectraFile(cloud, regions, picked) {
  const quoted = (name) => `"${name.replaceAll('"', '""')}"`;
  const places = picked.map(({ point }) => cloud.millimetres(point).map((mm) => mm.toFixed(1)).join(" "));
  const names = [
    ...regions.flatMap(({ name }) => [quoted(`mean of ${name}`), quoted(`standard deviation in ${name}`)]),
    ...places.map((place) => `reflectance at ${place} mm`),
  ];
  const columns = [...regions.flatMap(({ spectrum, sd }) => [spectrum, sd]), ...picked.map(({ spectrum }) => spectrum)];
  const rows = cloud.wavelengths.map((nm, i) => [nm, ...columns.map((column) => column[i].toFixed(5))]);
  return [["wavelength_nm", ...names], ...rows].map((row) => row.join(",")).join("\n") + "\n";
}

/** All points of the page in metres, and which of them each region holds: its edge lies between points. */
function regionFile(cloud, regions) {
  const metres = (point) => cloud.millimetres(point).map((mm) => Number((mm / 1000).toFixed(6)));
  return JSON.stringify({
    kind: FILE_KIND,
    points_m: Array.from({ length: cloud.count }, (_, point) => metres(point)),
    regions: regions.map(({ name, points }) => ({ name, points })),
  });
}

/** The nearest of some places (metres) for each of the page's points, within a reach; -1 where there is none. */
function nearestOf(cloud, places, reach) {
  const cells = new Map(), key = (x, y, z) => (x * 65536 + y) * 65536 + z;
  const cellOf = (place) => place.map((part) => Math.floor(part / reach));
  places.forEach((place, i) => {
    const at = key(...cellOf(place));
    if (cells.has(at)) cells.get(at).push(i); else cells.set(at, [i]);
  });
  const around = [-1, 0, 1].flatMap((x) => [-1, 0, 1].flatMap((y) => [-1, 0, 1].map((z) => [x, y, z])));
  return Array.from({ length: cloud.count }, (_, point) => {
    const own = cloud.millimetres(point).map((mm) => mm / 1000), cell = cellOf(own);
    let nearest = -1, least = reach * reach;
    for (const step of around) {
      for (const i of cells.get(key(...cell.map((part, axis) => part + step[axis]))) ?? []) {
        const squared = own.reduce((sum, part, axis) => sum + (part - places[i][axis]) ** 2, 0);
        if (squared <= least) [nearest, least] = [i, squared];
      }
    }
    return nearest;
  });
}

/** Names and points of the regions in a file: of the page's points those whose nearest one there is in the region. */
function regionsOf(cloud, text) {
  let content;
  try { content = JSON.parse(text); } catch { throw new Error("the file is no JSON; give one that was saved here"); }
  const places = content?.points_m, isPlace = (place) => place?.length === 3 && place.every(Number.isFinite);
  const isRegion = (one) => typeof one?.name === "string" && one.name.trim() && Array.isArray(one.points);
  if (content?.kind !== FILE_KIND || !content.regions?.length || !content.regions.every(isRegion)
    || !places?.length || !places.every(isPlace)) {
    throw new Error("the file holds no regions; give one that was saved here");
  }
  // The spacing of as many points on this surface as the file has.
  const spacing = cloud.spacing * cloud.reach * Math.sqrt(cloud.count / places.length);
  const nearest = nearestOf(cloud, places, FAR_SPACINGS * spacing);
  if (nearest.filter((i) => i >= 0).length <= cloud.count / 2) {
    throw new Error("the regions were drawn on another object, or in another position");
  }
  const every = Array.from({ length: cloud.count }, (_, point) => point);
  const found = content.regions.map(({ name, points }) => {
    const chosen = new Set(points);
    return { name, points: every.filter((point) => chosen.has(nearest[point])) };
  }).filter(({ points }) => points.length);
  if (!found.length) throw new Error("its regions hold none of this page's points; write the report with more --points");
  return found;
}

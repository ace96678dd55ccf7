// Regions that are drawn on the object: their points, their means, and the file that `traits --roi-file` reads.

const FRONT_DEPTH = 0.05;
const FILE_KIND = "hsi-sc-nerf regions";

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

function meanAndSd(values) {
  const finite = values.filter(Number.isFinite), mean = finite.reduce((a, b) => a + b, 0) / finite.length;
  return [mean, Math.sqrt(finite.reduce((a, b) => a + (b - mean) ** 2, 0) / finite.length)];
}

/** Area (cm²), mean spectrum with its standard deviation, and the mean of each index, of points of the cloud. */
function measured(cloud, points) {
  const indices = cloud.scalars.map((scalar, i) => ({ ...scalar, i })).filter(({ index }) => index);
  return {
    area_cm2: points.reduce((area, point) => area + cloud.areas_cm2[point], 0),
    ...cloud.meanAndSd(points),
    indices: indices.map(({ name, i }) => {
      const values = cloud.scalar(i);
      return { name, mean_sd: meanAndSd(Array.from(points, (point) => values[point])) };
    }),
  };
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

/** Names and points of the regions in a file that was saved from a page with the same points. */
function regionsOf(cloud, text) {
  let content;
  try { content = JSON.parse(text); } catch { throw new Error("the file is no JSON; give one that was saved here"); }
  if (content?.kind !== FILE_KIND || !Array.isArray(content.regions)) {
    throw new Error("the file holds no regions; give one that was saved here");
  }
  const fits = content.points_m?.length === cloud.count && [0, cloud.count - 1].every((point) => cloud
    .millimetres(point).every((mm, axis) => Math.abs(mm / 1000 - content.points_m[point][axis]) < 1e-4));
  if (!fits) throw new Error("the regions were drawn on another cloud");
  return content.regions.map(({ name, points }) => ({
    name: String(name), points: points.filter((point) => Number.isInteger(point) && point >= 0 && point < cloud.count),
  })).filter(({ points }) => points.length);
}

// The cloud as the page carries it (hsi_sc_nerf/report/cloud.py): bytes in base64, spectra in a basis.

const MISSING = 65535;
const BLANK = [0.5, 0.5, 0.5];

function decode(base64, Type) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return new Type(bytes.buffer);
}

class Cloud {
  constructor(payload) {
    this.count = payload.count;
    this.centre = payload.centre_m;
    this.reach = payload.reach_m;
    this.spacing = payload.spacing;
    this.positions = decode(payload.positions, Int16Array);
    this.normals = decode(payload.normals, Int8Array);
    this.wavelengths = payload.wavelengths_nm;
    this.mean = payload.mean;
    this.rank = payload.rank;
    this.basis = decode(payload.basis, Float32Array);
    this.coefficients = decode(payload.coefficients, Int16Array);
    this.composites = payload.composites;
    const decoded = (scalar) => ({ ...scalar, counts: decode(scalar.data, Uint16Array) });
    this.scalars = payload.scalars.map(decoded);
    this.classifiers = payload.classifiers.map((one) => ({ ...one, labels: decode(one.labels, Uint16Array) }));
    this.areas_cm2 = this.numbers(decoded(payload.areas_cm2));
    this.colours = decode(payload.colour_map, Uint8Array);
  }

  /** Reflectance of all points in a band. */
  band(index) {
    const bands = this.wavelengths.length, values = new Float32Array(this.count).fill(this.mean[index]);
    for (let k = 0; k < this.rank; k++) {
      const weight = this.basis[k * bands + index];
      for (let i = 0, at = k; i < this.count; i++, at += this.rank) values[i] += weight * this.coefficients[at];
    }
    return values;
  }

  /** Reflectance of a point in all bands. */
  spectrum(point) {
    return this.meanAndSd([point]).spectrum;
  }

  /** Mean and standard deviation of the points' reflectance in all bands, from those of their coefficients. */
  meanAndSd(points) {
    const { rank, coefficients, basis } = this, bands = this.wavelengths.length, count = points.length;
    const ranks = Array.from({ length: rank }, (_, k) => k);
    const means = ranks.map((k) => points.reduce((sum, point) => sum + coefficients[point * rank + k], 0) / count);
    const shared = ranks.map((k) => ranks.map((l) => (l > k ? 0 : points.reduce((sum, point) => sum
      + (coefficients[point * rank + k] - means[k]) * (coefficients[point * rank + l] - means[l]), 0) / count)));
    const spectrum = [], sd = [];
    for (let band = 0; band < bands; band++) {
      const weights = ranks.map((k) => basis[k * bands + band]);
      spectrum.push(this.mean[band] + weights.reduce((sum, weight, k) => sum + weight * means[k], 0));
      const variance = weights.reduce((sum, weight, k) => sum + weight * weights.slice(0, k + 1).reduce(
        (part, other, l) => part + (l < k ? 2 : 1) * other * shared[k][l], 0), 0);
      sd.push(Math.sqrt(Math.max(0, variance)));
    }
    return { spectrum, sd };
  }

  /** A number of each point, NaN where it has none. */
  scalar(index) {
    return this.numbers(this.scalars[index]);
  }

  numbers({ counts, range: [low, high] }) {
    return Float32Array.from(counts, (c) => (c === MISSING ? NaN : low + (c / (MISSING - 1)) * (high - low)));
  }

  nearestBand(nm) {
    let best = 0;
    this.wavelengths.forEach((w, i) => { if (Math.abs(w - nm) < Math.abs(this.wavelengths[best] - nm)) best = i; });
    return best;
  }

  /** Place of a point in the object frame, millimetres. */
  millimetres(point) {
    return [0, 1, 2].map((axis) => (this.centre[axis] + (this.positions[3 * point + axis] / 32767) * this.reach) * 1e3);
  }

  /** Red, green, blue (0 to 255) of values on the colour map between two ends. */
  mapped(values, low, high) {
    const rgb = new Uint8Array(3 * this.count);
    for (let i = 0; i < this.count; i++) {
      if (Number.isNaN(values[i])) { rgb.set(BLANK.map((part) => 255 * part), 3 * i); continue; }
      const place = Math.min(Math.max((values[i] - low) / (high - low || 1), 0), 1);
      const at = 3 * Math.min(Math.floor(place * 256), 255);
      rgb.set(this.colours.subarray(at, at + 3), 3 * i);
    }
    return rgb;
  }

  /** Red, green, blue (0 to 255) of the points of a classifier, by the colours of its classes (0 to 1). */
  classed({ labels }, colours) {
    const rgb = new Uint8Array(3 * this.count);
    labels.forEach((label, i) => rgb.set((label === MISSING ? BLANK : colours[label]).map((part) => 255 * part), 3 * i));
    return rgb;
  }

  /** Area (cm²) of each class of a classifier in some points, then that which it does not know. */
  classAreas({ labels, classes }, points) {
    const areas = Array(classes.length + 1).fill(0);
    for (const point of points) areas[Math.min(labels[point], classes.length)] += this.areas_cm2[point];
    return areas;
  }

  /** Red, green, blue (0 to 255) of three bands, `white` of reflectance at full brightness. */
  composed(bands, white) {
    const rgb = new Uint8ClampedArray(3 * this.count);
    bands.forEach((values, channel) => {
      for (let i = 0; i < this.count; i++) rgb[3 * i + channel] = (255 * values[i]) / white;
    });
    return new Uint8Array(rgb.buffer);
  }
}

/** A quantile of the finite values, from every tenth of them where there are many. */
function quantile(values, share) {
  const step = values.length > 5000 ? 10 : 1, some = [];
  for (let i = 0; i < values.length; i += step) if (Number.isFinite(values[i])) some.push(values[i]);
  some.sort((a, b) => a - b);
  return some.length ? some[Math.min(some.length - 1, Math.floor(share * some.length))] : 1;
}

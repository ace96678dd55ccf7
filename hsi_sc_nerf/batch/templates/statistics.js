// Medians, quantiles and outliers of numbers that may be missing (null).
const FAR = 3.5, FEWEST = 5, SD_OF_MAD = 1.4826;

/** Value below which a fraction of the sorted numbers lies, interpolated. */
function quantile(sorted, fraction) {
  const at = (sorted.length - 1) * fraction, low = Math.floor(at);
  return sorted[low] + (at - low) * ((sorted[low + 1] ?? sorted[low]) - sorted[low]);
}

const ascending = (values) => values.filter((value) => value !== null).sort((a, b) => a - b);

/** Rows by their group, in the order of the names; numbers inside of names count as numbers. */
function grouped(rows, groupOf) {
  const groups = new Map();
  for (const row of rows) {
    const name = groupOf(row);
    if (!groups.has(name)) groups.set(name, []);
    groups.get(name).push(row);
  }
  return new Map([...groups].sort(([a], [b]) => inOrder(a, b)));
}

const inOrder = (a, b) => String(a).localeCompare(String(b), undefined, { numeric: true });

/** Of each row 1 or -1 where it is far above or below the median of its group, else 0. */
function outlierSides(groups, valueOf) {
  const sides = new Map();
  for (const rows of groups.values()) {
    const sorted = ascending(rows.map(valueOf));
    if (sorted.length < FEWEST) continue;
    const middle = quantile(sorted, 0.5);
    const deviation = SD_OF_MAD * quantile(ascending(sorted.map((value) => Math.abs(value - middle))), 0.5);
    for (const row of rows) {
      const far = valueOf(row) === null ? 0 : valueOf(row) - middle;
      if (deviation > 0 && Math.abs(far) > FAR * deviation) sides.set(row, Math.sign(far));
    }
  }
  return sides;
}

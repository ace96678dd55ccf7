// The table: its head sorts, its rows link to the reports, its cells tell how uncertain a value is and what is far off.
const ROBUST_COLUMNS = ["size", "spectrum", "index", "class", "region", "score", "cost"];

/** An element with properties and content; texts from files are text, never markup. */
function element(tag, properties = {}, ...content) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...content);
  return made;
}

/** A number with as many digits as its uncertainty calls for, or four. */
function shownNumber(value, spread) {
  if (!(spread > 0)) return String(Number(value.toPrecision(Math.abs(value) >= 1e4 ? 6 : 4)));
  const decimals = Math.min(12, Math.max(0, 1 - Math.floor(Math.log10(spread))));
  return `${value.toFixed(decimals)} ± ${spread.toFixed(decimals)}`;
}

/** A row's number in a column; the user's own, such as a date or a label, as it is. */
function shownValue(column, value, row) {
  return column.group === "list" ? String(value) : shownNumber(value, column.spread === null ? null : row[column.spread]);
}

const headed = (column) => column.label + (column.unit ? `, ${column.unit}` : "");

/** The object's name, and which of several on the table it is. */
function nameOf(data, index) {
  const row = data.rows[index], piece = row[data.places.piece];
  return String(row[data.places.object]) + (piece ? `, piece ${piece}` : "");
}

/** The object's name and picture; a link where it has a report. */
function objectCell(data, index) {
  const name = nameOf(data, index), cell = element("th", { scope: "row" });
  const link = data.reports[index] ? element("a", { href: data.reports[index] }) : element("span");
  link.className = "object";
  if (data.pictures[index]) link.append(element("img", { src: data.pictures[index], alt: "", loading: "lazy" }));
  link.append(element("span", {}, name));
  cell.append(link);
  return cell;
}

function statusCell(data, row) {
  const [status, step, sentence] = ["status", "step", "sentence"].map((name) => row[data.places[name]]);
  const level = { done: "", unfinished: "amber" }[status] ?? "red";
  const cell = element("td", { className: sentence ? "long" : "" }, element("strong", { className: level }, status));
  if (step) cell.append(` (${step}) ${sentence}`);
  return cell;
}

function flagsCell(data, row) {
  const quality = row[data.places.quality], flags = row[data.places.flags];
  const cell = element("td", { className: flags ? "long" : "" });
  if (quality) cell.append(element("strong", { className: quality }, quality));
  if (flags) cell.append(` ${flags.split(";").join(", ")}`);
  return cell;
}

/** A cell of a trait or of the list of sessions. `side` is that of `outlierSides`. */
function valueCell(column, row, at, side) {
  const value = row[at];
  if (value === null) return element("td");
  if (column.kind !== "number") return element("td", {}, column.kind === "truth" ? (value ? "yes" : "no") : value);
  const [shown, uncertain] = shownValue(column, value, row).split(" ± ");
  const cell = element("td", { className: "number" });
  if (side) {
    const word = `outlier, ${side > 0 ? "above" : "below"} its group`;
    const mark = element("span", { className: "odd", title: word, role: "img" }, side > 0 ? "▲" : "▼");
    mark.setAttribute("aria-label", word);
    cell.append(mark, " ");
  }
  cell.append(shown);
  if (uncertain) cell.append(element("span", { className: "spread" }, ` ± ${uncertain}`));
  return cell;
}

/** Order of two rows by a column; what is missing comes last, whichever way it is sorted. */
function compareRows(at, kind, descending) {
  return (a, b) => {
    if (a[at] === null || b[at] === null || a[at] === "" || b[at] === "") {
      return (a[at] === null || a[at] === "") - (b[at] === null || b[at] === "");
    }
    return (descending ? -1 : 1) * (kind === "text" ? inOrder(a[at], b[at]) : a[at] - b[at]);
  };
}

/** Draw the head with a button a column, which calls `sortBy`. */
function drawHead(thead, data, shown, sorted, sortBy) {
  const cells = shown.map((at) => {
    const column = data.columns[at], button = element("button", { type: "button", title: column.definition }, headed(column));
    button.addEventListener("click", () => sortBy(at));
    const cell = element("th", { scope: "col", className: column.kind === "number" ? "number" : "" }, button);
    if (sorted.at === at) cell.setAttribute("aria-sort", sorted.descending ? "descending" : "ascending");
    return cell;
  });
  const focused = [...thead.querySelectorAll("button")].indexOf(document.activeElement);
  thead.replaceChildren(element("tr", {}, ...cells));
  if (focused >= 0) thead.querySelectorAll("button")[focused]?.focus();
}

/** Draw the rows of these objects, in this order. */
function drawRows(tbody, data, shown, order, groups) {
  const sides = new Map(shown.filter((at) => ROBUST_COLUMNS.includes(data.columns[at].group) && data.columns[at].kind === "number")
    .map((at) => [at, outlierSides(groups, (index) => data.rows[index][at])]));
  tbody.replaceChildren(...order.map((index) => {
    const row = data.rows[index];
    return element("tr", {}, ...shown.map((at) =>
      at === data.places.object ? objectCell(data, index)
        : at === data.places.status ? statusCell(data, row)
        : at === data.places.flags ? flagsCell(data, row)
        : valueCell(data.columns[at], row, at, sides.get(at)?.get(index))));
  }));
}

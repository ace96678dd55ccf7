// What is shown, by the controls of the page, and when it is drawn anew.
const data = JSON.parse(document.getElementById("objects").textContent);
const find = (selector) => document.querySelector(selector);
const named = (name) => find(`[name="${name}"]`);
const everyRow = data.rows.map((_, index) => index);
// The order is kept for who comes back from a report, as the browser keeps the controls.
const kept = history.state, isKept = kept !== null && data.columns[kept.at]?.label === kept.label;
const sorted = isKept ? { at: kept.at, descending: kept.descending } : { at: null, descending: false };
const boxes = new Map();
const ALL = "all objects", EMPTY = "(empty)", MOST_CHOICES = 30, LISTED_OUTLIERS = 30;
const textOf = (value) => (value === null || value === "" ? EMPTY : String(value));

const traits = [...data.columns.keys()].filter((at) => {
  const column = data.columns[at];
  const isSpread = data.columns.some((one) => one.spread === at);
  return column.kind === "number" && !isSpread && data.rows.some((row) => row[at] !== null);
});
const groupings = [...data.columns.keys()].filter((at) => ![data.places.object, data.places.session].includes(at)
  && (data.columns[at].group === "list" || at === data.places.status || at === data.places.quality));

/** Fill a choice with columns. */
function offer(select, columns, first, chosenAt) {
  select.append(...(first ? [element("option", { value: "" }, first)] : []),
    ...columns.map((at) => element("option", { value: at, selected: at === chosenAt }, headed(data.columns[at]))));
}

/** A choice for each column of few values. */
function offerFacets(place) {
  for (const at of groupings) {
    const values = [...new Set(data.rows.map((row) => textOf(row[at])))].sort(inOrder);
    if (values.length < 2 || values.length > MOST_CHOICES) continue;
    const select = element("select", {}, element("option", { value: "" }, "all"),
      ...values.map((value) => element("option", { value: `=${value}` }, value)));
    select.dataset.column = at;
    place.append(element("label", {}, `${data.columns[at].label} `, select));
  }
}

function offerColumns(place) {
  for (const group of new Set(data.columns.map((column) => column.group))) {
    const labels = [...data.columns.keys()].filter((at) => data.columns[at].group === group
      && ![data.places.object, data.places.status].includes(at)).map((at) => {
      const checked = data.columns[at].shown && data.rows.some((row) => row[at] !== null);
      const box = element("input", { type: "checkbox", checked, title: data.columns[at].definition });
      box.addEventListener("change", drawTable);
      boxes.set(at, box);
      return element("label", {}, box, ` ${headed(data.columns[at])}`);
    });
    if (labels.length) place.append(element("fieldset", {}, element("legend", {}, group), ...labels));
  }
}

/** Objects that the search and all choices let through. */
function visible() {
  const words = named("words").value.toLowerCase().split(/\s+/).filter(Boolean);
  const facets = [...document.querySelectorAll(".facets select")].filter((select) => select.value);
  return everyRow.filter((index) => {
    const row = data.rows[index];
    const text = row.filter((value) => typeof value === "string").join(" ").toLowerCase();
    return words.every((word) => text.includes(word))
      && facets.every((select) => `=${textOf(row[select.dataset.column])}` === select.value);
  });
}

const groupOf = (index) => {
  const at = named("group").value;
  return at === "" ? ALL : textOf(data.rows[index][at]);
};
const sidesOf = (at) => outlierSides(grouped(everyRow, groupOf), (index) => data.rows[index][at]);

function drawTable() {
  const chosen = [...data.columns.keys()].filter((at) => at === data.places.status || boxes.get(at)?.checked);
  const shown = [data.places.object, ...chosen];
  const order = visible();
  if (sorted.at !== null) {
    const compare = compareRows(sorted.at, data.columns[sorted.at].kind, sorted.descending);
    order.sort((a, b) => compare(data.rows[a], data.rows[b]));
  }
  drawHead(find("thead"), data, shown, sorted, (at) => {
    Object.assign(sorted, { at, descending: sorted.at === at && !sorted.descending });
    history.replaceState({ ...sorted, label: data.columns[at].label }, "");
    drawTable();
  });
  drawRows(find("tbody"), data, shown, order, grouped(everyRow, groupOf));
  named("count").value = `${order.length} of ${everyRow.length} shown`;
}

function drawCharts() {
  const groups = grouped(visible(), groupOf);
  if (!traits.length) {
    for (const place of document.querySelectorAll(".drawing")) place.textContent = "No object has a trait yet.";
    return;
  }
  const [x, y, up] = ["x", "y", "up"].map((name) => Number(named(name).value)), sides = sidesOf(y);
  drawDistribution(find("#distribution .drawing"), data, y, groups, sides);
  const odd = [...groups.values()].flat().filter((index) => sides.has(index));
  const links = odd.slice(0, LISTED_OUTLIERS).map((index) => element(data.reports[index] ? "a" : "span",
    data.reports[index] ? { href: data.reports[index] } : {},
    `${nameOf(data, index)} ${sides.get(index) > 0 ? "▲" : "▼"}`));
  const more = odd.length > links.length ? ` and ${odd.length - links.length} more` : "";
  find(".outliers").replaceChildren(odd.length ? "Outliers: " : "No outliers.", ...links.flatMap((link) => [link, " "]), more);
  drawScatter(find("#scatter .drawing"), find(".legend"), data, [x, up], groups, [sidesOf(x), sidesOf(up)]);
}

function drawAll() {
  drawTable();
  drawCharts();
}

offerFacets(find(".facets"));
offerColumns(find(".chooser div"));
offer(named("group"), groupings, ALL);
const first = traits.includes(data.places.volume) ? data.places.volume : traits[0];
const index = traits.find((at) => data.columns[at].group === "index") ?? traits[1] ?? first;
for (const [name, at] of [["y", first], ["x", first], ["up", index]]) offer(named(name), traits, "", at);
find("form.filters").addEventListener("input", drawAll);
find("form.filters").addEventListener("reset", () => setTimeout(drawAll));
for (const name of ["x", "y", "up"]) named(name).addEventListener("input", drawCharts);
let drawnWidth = window.innerWidth;
window.addEventListener("resize", () => {
  if (window.innerWidth !== drawnWidth) drawCharts();
  drawnWidth = window.innerWidth;
});
// Only now has the browser put back what was chosen before a report was opened.
window.addEventListener("pageshow", drawAll);

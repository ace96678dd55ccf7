// The picture to save: the drawing with its bar of millimetres, and the legend of its colours below.

const PICTURE = { margin: 12, line: 18, bar: 10, font: "13px sans-serif" };

/** Words in lines that are at most so wide. */
function wrapped(context, text, width) {
  const lines = [];
  for (const word of text.split(/\s+/).filter(Boolean)) {
    const longer = lines.length ? `${lines.at(-1)} ${word}` : word;
    if (lines.length && context.measureText(longer).width <= width) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}

/** A canvas without a background, whose dark letters have light edges, so that they can be read on any.
 * `scale` is the bar of millimetres, `legend` the colours' meaning, `colours` the colour map. */
function pictureOf(canvas, scale, legend, colours) {
  const { margin, line, bar, font } = PICTURE, [wide, high] = [canvas.clientWidth, canvas.clientHeight];
  const made = element("canvas", {}), context = made.getContext("2d");
  context.font = font;
  const ends = [...legend.querySelectorAll(".ends span")].map((span) => span.textContent);
  const own = legend.querySelector(".bar"), items = own ? [] : [...legend.children];
  const texts = own ? [{ lines: wrapped(context, ends[1], wide - 2 * margin) }] : items.map((item) => {
    const mark = item.querySelector(".dot"), lines = wrapped(context, item.textContent, wide - 2 * margin - line);
    return { lines, fill: mark && getComputedStyle(mark).backgroundColor };
  });
  const count = texts.reduce((sum, { lines }) => sum + lines.length, own ? 1 : 0);
  const ratio = canvas.width / wide;
  Object.assign(made, { width: canvas.width, height: canvas.height + Math.ceil(ratio * (count * line + bar + 2 * margin)) });
  context.drawImage(canvas, 0, 0);
  context.scale(ratio, ratio);
  Object.assign(context, { font, lineWidth: 3, lineJoin: "round", strokeStyle: "#fff", fillStyle: "#000" });

  function write(text, x, y, align = "left") {
    context.textAlign = align;
    context.strokeText(text, x, y);
    context.fillText(text, x, y);
  }

  const length = scale.getBoundingClientRect().width;
  context.strokeRect(margin, high - margin - 3, length, 3);
  context.fillRect(margin, high - margin - 3, length, 3);
  write(scale.textContent, margin + length / 2, high - margin - 8, "center");
  let y = high + margin;
  if (own) {
    const steps = colours.length / 3, ramp = context.createLinearGradient(margin, 0, wide - margin, 0);
    for (let i = 0; i < steps; i++) {
      ramp.addColorStop(i / (steps - 1), `rgb(${colours.subarray(3 * i, 3 * i + 3).join(" ")})`);
    }
    context.fillStyle = ramp;
    context.fillRect(margin, y, wide - 2 * margin, bar);
    context.fillStyle = "#000";
    write(ends[0], margin, y + bar + line - 4);
    write(ends[2], wide - margin, y + bar + line - 4, "right");
    y += bar + line;
  }
  for (const { lines, fill } of texts) {
    if (fill) Object.assign(context, { fillStyle: fill }).fillRect(margin, y + 4, bar, bar);
    context.fillStyle = "#000";
    for (const text of lines) write(text, own ? wide / 2 : margin + (fill ? line : 0), (y += line) - 4, own ? "center" : "left");
  }
  return made;
}

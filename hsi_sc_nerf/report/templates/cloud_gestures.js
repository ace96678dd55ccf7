// Pointers, wheel and keys on the object: they turn, move and zoom it, pick points and draw lines.

/** `pick` is told a place, `closeLine` a line of places, the brush's radius if it is one, and whether it takes away. */
function listen(root, renderer, fields, { pick, closeLine, undo }) {
  const canvas = root.querySelector("canvas");
  const lasso = root.querySelector(".lasso"), stroke = root.querySelector(".stroke"), tip = root.querySelector(".tip");
  const withBrush = () => fields.drawing.checked && fields.tool.value === "brush";
  const radius = () => (withBrush() ? Number(fields.brush.value) : null);

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

  /** The brush's outline, where the pointer is or, for keys, in the middle. */
  function showBrush(place) {
    const [cx, cy] = place ?? [canvas.clientWidth / 2, canvas.clientHeight / 2], r = Number(fields.brush.value);
    const shown = withBrush() && (place || canvas.matches(":focus-visible"));
    for (const [name, value] of Object.entries({ cx, cy, r: shown ? r : 0 })) tip.setAttribute(name, value);
    stroke.setAttribute("stroke-width", 2 * r);
  }

  const pointers = new Map();
  let travelled = 0, line = null;
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return; // whose menu may swallow the end of it
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    travelled = pointers.size > 1 ? Infinity : 0;
    fields.turning.checked = false;
    line = fields.drawing.checked && pointers.size === 1 ? [[event.offsetX, event.offsetY]] : null;
    showLine();
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId), now = [event.offsetX, event.offsetY];
    showBrush(now);
    if (!before) return;
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const other = [...pointers].find(([id]) => id !== event.pointerId);
    pointers.set(event.pointerId, now);
    travelled += Math.hypot(dx, dy);
    if (line) {
      line.push(now);
      showLine();
    } else if (other) {
      const apart = ([a, b]) => Math.max(1, Math.hypot(a - other[1][0], b - other[1][1]));
      zoom(apart(before) / apart(now));
    } else if (event.shiftKey) {
      const scale = (2 * renderer.distance * Math.tan(FIELD_OF_VIEW / 2)) / canvas.clientHeight;
      move(dx * scale, -dy * scale);
    } else if (travelled > 3) turn(0.01 * dx, 0.01 * dy);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (line && (travelled > 3 || withBrush())) closeLine(line, radius(), event.shiftKey);
    else if (travelled <= 3) pick(event.offsetX, event.offsetY);
    stopLine();
  });
  canvas.addEventListener("pointercancel", (event) => { pointers.delete(event.pointerId); stopLine(); });
  canvas.addEventListener("pointerleave", () => showBrush());
  canvas.addEventListener("focus", () => showBrush());
  canvas.addEventListener("blur", () => showBrush());
  for (const field of [fields.drawing, fields.tool, fields.brush]) field.addEventListener("input", () => showBrush());
  function showLine() {
    lasso.setAttribute("points", line && !withBrush() ? line.join(" ") : "");
    stroke.setAttribute("points", line && withBrush() ? [line[0], ...line].join(" ") : "");
  }
  function stopLine() {
    line = null;
    showLine();
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const moves = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const by = moves[event.key];
    // The browser's own keys; where brackets need AltGr, it counts as Alt, or as Ctrl and Alt.
    if (event.metaKey || ((event.ctrlKey || event.altKey) && !"[]".includes(event.key))) return;
    if (by && event.shiftKey) move(by[0], by[1]);
    else if (by) turn(...by);
    else if ("+-".includes(event.key)) zoom(event.key === "+" ? 0.9 : 1.1);
    else if ("[]".includes(event.key)) {
      fields.brush.value = Number(fields.brush.value) + (event.key === "]" ? 2 : -2);
      showBrush();
    } else if (event.key === "Enter" || event.key === " ") {
      const middle = [canvas.clientWidth / 2, canvas.clientHeight / 2];
      if (withBrush()) closeLine([middle], radius(), event.shiftKey); else pick(...middle);
    } else if (event.key === "Escape" && line) {
      pointers.clear();
      stopLine();
    } else return;
    fields.turning.checked = false;
    event.preventDefault();
  });
  document.addEventListener("keydown", (event) => {
    const typing = event.target.matches(".regions input:not([type])");
    if (event.key.toLowerCase() !== "z" || event.shiftKey || !(event.ctrlKey || event.metaKey) || typing) return;
    undo();
    event.preventDefault();
  });
}

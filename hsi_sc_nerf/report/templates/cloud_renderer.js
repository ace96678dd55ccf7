// Points with colours in WebGL, seen by a camera that circles round the object's centre; z is up.

const VERTEX_SHADER = `
attribute vec3 position; attribute vec3 normal; attribute vec3 colour;
uniform mat4 matrix; uniform vec3 eye; uniform float size; uniform float shading;
varying vec3 shown;
void main() {
  gl_Position = matrix * vec4(position, 1.0);
  gl_PointSize = max(1.0, size / gl_Position.w);
  vec3 to_eye = normalize(eye - position);
  float facing = dot(normal, to_eye) / max(length(normal), 0.001);
  if (facing < -0.3 && length(normal) > 0.5) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  shown = colour * mix(1.0, 0.35 + 0.65 * max(facing, 0.0), shading);
}`;
const FRAGMENT_SHADER = `
precision mediump float;
varying vec3 shown; uniform vec4 ring;
void main() {
  vec2 place = 2.0 * gl_PointCoord - 1.0;
  float r = dot(place, place);
  if (r > 1.0) discard;
  gl_FragColor = vec4(ring.a > 0.0 ? (r > 0.45 ? vec3(1.0) : ring.rgb) : shown, 1.0);
}`;
const FIELD_OF_VIEW = 0.6;

class Renderer {
  constructor(canvas, cloud) {
    const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL");
    this.canvas = canvas; this.gl = gl; this.cloud = cloud;
    this.azimuth = 0; this.elevation = 0.25; this.distance = 4.1; this.shift = [0, 0];
    this.size = 1; this.shading = 0; this.marks = []; this.onDraw = () => {};
    this.rgb = new Uint8Array(3 * cloud.count);
    this.load();
    // Points of some times the distance of neighbours cover the gaps between them.
    this.spacing = 2.8 * cloud.spacing;
    // Phones take the graphics memory away from a page that is not looked at.
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.load(); this.draw(); });
  }

  /** Bring the program and the points into the graphics memory. */
  load() {
    const { gl, cloud } = this;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    this.places = Object.fromEntries(["matrix", "eye", "size", "shading", "ring"].map(
      (name) => [name, gl.getUniformLocation(program, name)]));
    this.program = program;
    this.attribute("position", cloud.positions, gl.SHORT);
    this.attribute("normal", cloud.normals, gl.BYTE);
    this.colourBuffer = this.attribute("colour", this.rgb, gl.UNSIGNED_BYTE);
    gl.enable(gl.DEPTH_TEST);
  }

  attribute(name, values, type) {
    const gl = this.gl, buffer = gl.createBuffer(), place = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, type, true, 0, 0);
    return buffer;
  }

  colour(rgb) {
    this.rgb = rgb;
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.colourBuffer);
    this.gl.bufferSubData(this.gl.ARRAY_BUFFER, 0, rgb);
    this.draw();
  }

  /** Camera: its place, and the matrix (by columns) from the cloud's [-1, 1] to the picture. */
  camera() {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth),
      Math.cos(this.elevation), Math.sin(this.elevation)];
    const back = [ca * ce, sa * ce, se], right = [-sa, ca, 0], up = [-ca * se, -sa * se, ce];
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2), aspect = this.canvas.width / this.canvas.height;
    const near = Math.max(0.05, this.distance - 2.5), far = this.distance + 2.5;
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    const matrix = new Float32Array(16);
    for (let j = 0; j < 3; j++) {
      matrix[4 * j] = (f / aspect) * right[j];
      matrix[4 * j + 1] = f * up[j];
      matrix[4 * j + 2] = a * back[j];
      matrix[4 * j + 3] = -back[j];
    }
    matrix[12] = (f / aspect) * this.shift[0];
    matrix[13] = f * this.shift[1];
    matrix[14] = -a * this.distance + b;
    matrix[15] = this.distance;
    return { matrix, eye: back.map((part) => part * this.distance) };
  }

  draw() {
    const gl = this.gl, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((s) => Math.max(1, s * ratio | 0));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { matrix, eye } = this.camera(), scale = height / Math.tan(FIELD_OF_VIEW / 2) / 2;
    gl.uniformMatrix4fv(this.places.matrix, false, matrix);
    gl.uniform3fv(this.places.eye, eye);
    gl.uniform1f(this.places.shading, this.shading);
    gl.uniform1f(this.places.size, this.size * this.spacing * scale);
    gl.uniform4f(this.places.ring, 0, 0, 0, 0);
    gl.drawArrays(gl.POINTS, 0, this.cloud.count);
    gl.disable(gl.DEPTH_TEST);
    gl.uniform1f(this.places.size, 14 * ratio * this.distance);
    for (const mark of this.marks) {
      gl.uniform4f(this.places.ring, ...mark.rgb, 1);
      gl.drawArrays(gl.POINTS, mark.point, 1);
    }
    gl.enable(gl.DEPTH_TEST);
    this.onDraw();
  }

  /** Points that face the camera: their places (CSS pixels from the upper left corner) and depths. */
  project() {
    const { matrix: m, eye } = this.camera(), { positions: p, normals: n, count } = this.cloud, seen = [];
    const wide = this.canvas.clientWidth, high = this.canvas.clientHeight;
    for (let point = 0; point < count; point++) {
      const [a, b, c] = [p[3 * point] / 32767, p[3 * point + 1] / 32767, p[3 * point + 2] / 32767];
      const depth = m[3] * a + m[7] * b + m[11] * c + m[15];
      if (depth <= 0) continue;
      const [u, v, w] = [n[3 * point], n[3 * point + 1], n[3 * point + 2]];
      if ((eye[0] - a) * u + (eye[1] - b) * v + (eye[2] - c) * w < 0) continue;
      const x = ((m[0] * a + m[4] * b + m[8] * c + m[12]) / depth / 2 + 0.5) * wide;
      const y = (0.5 - (m[1] * a + m[5] * b + m[9] * c + m[13]) / depth / 2) * high;
      seen.push({ point, x, y, depth });
    }
    return seen;
  }

  /** CSS pixels of a length of the cloud, 1 by default, at the depth of the object's centre. */
  pixels(length = 1) {
    return (length * this.canvas.clientHeight) / Math.tan(FIELD_OF_VIEW / 2) / 2 / this.distance;
  }

  spacingPx() {
    return this.pixels(this.cloud.spacing);
  }

  /** The nearest point to the camera of those that a click (CSS pixels from the upper left corner) meets; -1: none. */
  pick(x, y) {
    const reach = Math.max(3, 0.6 * this.size * this.pixels(this.spacing));
    const met = this.project().filter((one) => (one.x - x) ** 2 + (one.y - y) ** 2 <= reach ** 2);
    return met.reduce((best, one) => (one.depth < best.depth ? one : best), { point: -1, depth: Infinity }).point;
  }
}

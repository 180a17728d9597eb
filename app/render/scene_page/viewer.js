// The viewer: one draw call per picture, and a picture only when something has changed.
const byId = (id) => document.getElementById(id);
const facts = JSON.parse(byId("facts").textContent);
const canvas = byId("view");
const kNoClass = 65535;
const kNear = 0.002, kFar = 6;  // of the scene's diagonal
const kAngle = 55 * Math.PI / 180;

function say_trouble(text) {
  byId("trouble").textContent = text;
  byId("trouble").hidden = false;
  document.body.dataset.state = "failed";
}

// ---- the mesh

async function inflated(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** Sums of differences, in place. */
function summed(numbers) {
  for (let i = 1; i < numbers.length; ++i) numbers[i] += numbers[i - 1];
  return numbers;
}

/** corners [3 T] of triangles, place [V, 4]: steps along the box and the class, color [V, 4]. */
function unpacked(buffer) {
  const count = facts.vertices, corners = summed(new Uint32Array(buffer, 0, 3 * facts.triangles));
  let at = corners.byteLength;
  const axes = [0, 1, 2].map((axis) => summed(new Uint16Array(buffer, at + 2 * count * axis, count)));
  at += 6 * count;
  const labels = new Uint16Array(buffer, at, count);
  at += 2 * count;
  const place = new Uint16Array(4 * count), color = new Uint8Array(4 * count);
  for (let v = 0; v < count; ++v) {
    for (let axis = 0; axis < 3; ++axis) place[4 * v + axis] = axes[axis][v];
    place[4 * v + 3] = labels[v];
  }
  for (let c = 0; c < 3; ++c) {
    const channel = new Uint8Array(buffer, at + count * c, count);
    for (let v = 0; v < count; ++v) color[4 * v + c] = channel[v];
  }
  return {corners, place, color};
}

// ---- drawing

const kVertex = `#version 300 es
layout(location = 0) in vec3 steps;
layout(location = 1) in vec4 photo;
layout(location = 2) in uint label;
uniform mat4 clip_from_world, eye_from_world;
uniform vec3 low, per_step;
out vec3 color, place;
flat out uint shown_label;
void main() {
  vec4 world = vec4(low + steps * per_step, 1.0);
  gl_Position = clip_from_world * world;
  place = (eye_from_world * world).xyz;
  color = photo.rgb;
  shown_label = label;
}`;
// Passes: 0 the photographs' colours, 1 class colours, 2 depth as 24 bits, 3 class as 16 bits.
const kFragment = `#version 300 es
precision highp float;
precision highp int;
in vec3 color, place;
flat in uint shown_label;
uniform int mode;
uniform uint classes;
uniform sampler2D palette;  // of each class, and one more for none; alpha 0: hidden
out vec4 pixel;
void main() {
  uint label = min(shown_label, classes);
  vec4 of_class = texelFetch(palette, ivec2(label, 0), 0);
  if (of_class.a < 0.5) discard;
  if (mode == 0) {
    pixel = vec4(color, 1.0);
  } else if (mode == 1) {
    vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
    pixel = vec4(of_class.rgb * (0.55 + 0.45 * abs(normal.z)), 1.0);
  } else if (mode == 2) {
    uint depth = uint(gl_FragCoord.z * 16777215.0);
    pixel = vec4(float(depth >> 16), float((depth >> 8) & 255u), float(depth & 255u), 255.0) / 255.0;
  } else {
    pixel = vec4(float(label >> 8), float(label & 255u), 0.0, 255.0) / 255.0;
  }
}`;

class Drawing {
  constructor(mesh) {
    const gl = this.gl = canvas.getContext("webgl2", {antialias: true, preserveDrawingBuffer: true});
    if (gl === null) throw new Error("This browser has no WebGL 2: take a newer one, or switch hardware acceleration on.");
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, kVertex], [gl.FRAGMENT_SHADER, kFragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    gl.useProgram(this.program);
    this.buffer(gl.ARRAY_BUFFER, mesh.place);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, 8, 0);
    gl.vertexAttribIPointer(2, 1, gl.UNSIGNED_SHORT, 8, 6);
    this.buffer(gl.ARRAY_BUFFER, mesh.color);
    gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 4, 0);
    for (const index of [0, 1, 2]) gl.enableVertexAttribArray(index);
    this.buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.corners);
    this.count = mesh.corners.length;
    this.palette = new Uint8Array(4 * (facts.classes.length + 1)).fill(255);
    facts.classes.forEach((one, i) => this.palette.set(one.color, 4 * i));
    this.palette.set([150, 150, 150], 4 * facts.classes.length);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    this.send_palette();
    gl.uniform3fv(this.place("low"), facts.low);
    gl.uniform3fv(this.place("per_step"), facts.high.map((h, i) => (h - facts.low[i]) / 65535));
    gl.uniform1ui(this.place("classes"), facts.classes.length);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);  // a room seen from outside is open
    this.target = gl.createFramebuffer();
    this.calls = 0;
  }
  place(name) { return this.gl.getUniformLocation(this.program, name); }
  buffer(kind, data) {
    this.gl.bindBuffer(kind, this.gl.createBuffer());
    this.gl.bufferData(kind, data, this.gl.STATIC_DRAW);
  }
  send_palette() {
    const gl = this.gl;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, this.palette.length / 4, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, this.palette);
  }
  show(label, shown) {
    this.palette[4 * label + 3] = shown ? 255 : 0;
    this.send_palette();
  }
  draw(mode, matrices, background = [0.082, 0.094, 0.11, 1]) {
    const gl = this.gl;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.place("clip_from_world"), false, matrices.clip);
    gl.uniformMatrix4fv(this.place("eye_from_world"), false, matrices.eye);
    gl.uniform1i(this.place("mode"), mode);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
    ++this.calls;
  }
  /** Bytes of a pass at a pixel from below, drawn beside the screen. */
  read(mode, matrices, x, y) {
    const gl = this.gl, color = gl.createRenderbuffer(), depth = gl.createRenderbuffer(), out = new Uint8Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    for (const [buffer, format, at] of [[color, gl.RGBA8, gl.COLOR_ATTACHMENT0], [depth, gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]]) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, canvas.width, canvas.height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, at, gl.RENDERBUFFER, buffer);
    }
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, y, 1, 1);
    this.draw(mode, matrices, [0, 0, 0, 0]);
    gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, out);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteRenderbuffer(color);
    gl.deleteRenderbuffer(depth);
    return out;
  }
}

// ---- the camera: it turns about a target, upright, in the scene turned to y up

const kTurn = rotation(facts.turn);
const kDiagonal = distance(facts.low, facts.high);
const kMiddle = facts.low.map((v, i) => (v + facts.high[i]) / 2);

class OrbitCamera {
  constructor() { this.outside(); }
  outside() {
    this.target = moved(kTurn, kMiddle).slice(0, 3);
    this.yaw = 0.7;
    this.pitch = 0.65;
    this.reach = 1.15 * kDiagonal * Math.max(1, 0.8 * canvas.clientHeight / Math.max(canvas.clientWidth, 1));
  }
  inside() {
    this.target = moved(kTurn, facts.eye).slice(0, 3);
    this.pitch = 0.1;
    this.reach = 1e-3 * kDiagonal;
  }
  forward() {
    const c = Math.cos(this.pitch);
    return [-Math.sin(this.yaw) * c, -Math.sin(this.pitch), -Math.cos(this.yaw) * c];
  }
  turn(dx, dy) {
    const near = this.reach < 0.05 * kDiagonal ? -1 : 1;  // inside, the picture follows the hand
    this.yaw -= near * dx * 0.006;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + near * dy * 0.006));
  }
  /** Pixels of the picture. */
  move(dx, dy) {
    const forward = this.forward(), right = unit(cross(forward, [0, 1, 0])), up = cross(right, forward);
    const per_pixel = 2 * Math.max(this.reach, 0.15 * kDiagonal) * Math.tan(kAngle / 2) / canvas.clientHeight;
    this.target = add(add(this.target, right, -dx * per_pixel), up, dy * per_pixel);
  }
  closer(factor) {
    if (this.reach * factor > 0.02 * kDiagonal && this.reach > 0.02 * kDiagonal) {
      this.reach = Math.min(4 * kDiagonal, this.reach * factor);
    } else {
      this.target = add(this.target, this.forward(), (1 - factor) * 0.2 * kDiagonal);
    }
  }
  matrices() {
    const forward = this.forward(), eye = add(this.target, forward, -this.reach);
    const eye_from_world = product(view_from(eye, forward), kTurn);
    const aspect = canvas.width / canvas.height;
    const projection = perspective(kAngle, aspect, kNear * kDiagonal, kFar * kDiagonal);
    return {clip: product(projection, eye_from_world), eye: eye_from_world, aspect};
  }
}

/** The place in the input's world behind a pixel (x from the left, y from below) at a depth of 0 to 1. */
function unprojected(matrices, x, y, depth) {
  const near = kNear * kDiagonal, far = kFar * kDiagonal, ndc = 2 * depth - 1;
  const z = 2 * far * near / (far + near - ndc * (far - near)), half = Math.tan(kAngle / 2);
  const at = [(2 * x / canvas.width - 1) * half * matrices.aspect * z, (2 * y / canvas.height - 1) * half * z, -z];
  const m = matrices.eye, back = transposed([...m.slice(0, 3), 0, ...m.slice(4, 7), 0, ...m.slice(8, 11), 0, 0, 0, 0, 1]);
  return moved(back, add(at, m.slice(12, 15), -1)).slice(0, 3);
}

// ---- the page

class Page {
  constructor(drawing) {
    this.drawing = drawing;
    this.camera = new OrbitCamera();
    this.mode = 0;
    this.points = [];
    byId("title").textContent = document.title;
    byId("about").lastElementChild.append(...facts.about.map((line) => Object.assign(document.createElement("p"), {textContent: line})));
    byId("colors").hidden = byId("legend").hidden = !facts.labels;
    byId("inside").parentElement.hidden = facts.eye === undefined;
    if (canvas.clientWidth < 600) byId("legend").open = false;
    this.list_classes();
    this.listen();
    new ResizeObserver(() => this.fit()).observe(canvas);
    this.fit();
  }

  list_classes() {
    const row = (name, color, label) => {
      const item = document.createElement("li"), box = document.createElement("input");
      const word = document.createElement("label"), swatch = document.createElement("span");
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => { this.drawing.show(label, box.checked); this.change(); });
      swatch.style.background = `rgb(${color})`;
      word.append(box, swatch, name);
      item.append(word);
      return item;
    };
    const rows = facts.classes.map((one, i) => row(one.name, one.color, i));
    byId("legend").lastElementChild.append(...rows, row("no class", [150, 150, 150], facts.classes.length));
  }

  listen() {
    const press = (on, off, act) => byId(on).addEventListener("click", () => {
      byId(on).setAttribute("aria-pressed", "true");
      byId(off).setAttribute("aria-pressed", "false");
      act();
      this.change();
    });
    press("photo", "class", () => { this.mode = 0; });
    press("class", "photo", () => { this.mode = 1; });
    press("outside", "inside", () => this.camera.outside());
    press("inside", "outside", () => this.camera.inside());
    const held = new Map();
    let travelled = 0;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
      if (held.size === 1) travelled = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (before === undefined) return;
      const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
      travelled += Math.hypot(dx, dy);
      held.set(event.pointerId, now);
      if (held.size === 2) {
        const other = [...held].find(([id]) => id !== event.pointerId)[1];
        this.camera.closer(Math.hypot(before[0] - other[0], before[1] - other[1]) / Math.max(1, Math.hypot(now[0] - other[0], now[1] - other[1])));
        this.camera.move(dx / 2, dy / 2);
      } else if (event.buttons & 2 || event.shiftKey) {
        this.camera.move(dx, dy);
      } else {
        this.camera.turn(dx, dy);
      }
      this.change();
    });
    const release = (event) => {
      const was_click = held.size === 1 && travelled < 5 && event.type === "pointerup" && event.button === 0;
      held.delete(event.pointerId);
      if (was_click) this.point(event.clientX, event.clientY);
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.closer(Math.exp(Math.max(-100, Math.min(100, event.deltaY)) * 0.002));
      this.change();
    }, {passive: false});
    canvas.addEventListener("keydown", (event) => {
      const act = {ArrowLeft: () => this.camera.turn(-20, 0), ArrowRight: () => this.camera.turn(20, 0), ArrowUp: () => this.camera.turn(0, -20),
        ArrowDown: () => this.camera.turn(0, 20), "+": () => this.camera.closer(0.9), "-": () => this.camera.closer(1.1),
        Escape: () => { this.points = []; }}[event.key];
      if (act === undefined) return;
      event.preventDefault();
      act();
      this.change();
    });
    canvas.addEventListener("webglcontextlost", () => say_trouble("The graphics device was lost. Load the page again."));
  }

  fit() {
    const scale = Math.min(2, window.devicePixelRatio || 1);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    this.change();
  }

  change() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.drawing.draw(this.mode, this.camera.matrices());
      this.mark();
    });
  }

  /** What lies under a place of the window: {place, label}, or null. */
  read(client_x, client_y) {
    const box = canvas.getBoundingClientRect(), matrices = this.camera.matrices();
    const x = Math.floor((client_x - box.left) * canvas.width / box.width);
    const y = canvas.height - 1 - Math.floor((client_y - box.top) * canvas.height / box.height);
    const depth = this.drawing.read(2, matrices, x, y);
    if (depth[3] === 0) return null;
    const label = this.drawing.read(3, matrices, x, y);
    const value = (depth[0] * 65536 + depth[1] * 256 + depth[2]) / 16777215;
    return {place: unprojected(matrices, x + 0.5, y + 0.5, value), label: label[0] * 256 + label[1]};
  }

  point(client_x, client_y) {
    const found = this.read(client_x, client_y);
    if (this.points.length === 2 || found === null) this.points = [];
    if (found !== null) this.points.push(found);
    this.change();
  }

  mark() {
    const {clip} = this.camera.matrices(), names = facts.classes.map((one) => one.name);
    const seen = this.points.map(({place}) => moved(clip, place));
    const on_screen = seen.map((p) => [(p[0] + 1) / 2 * canvas.clientWidth, (1 - p[1]) / 2 * canvas.clientHeight]);
    const element = (name, values) => {
      const made = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(values)) made.setAttribute(key, value);
      return made;
    };
    const shown = seen.every((p) => p[3] > 0) ? on_screen : [];
    const marks = shown.map(([cx, cy]) => element("circle", {cx, cy, r: 5}));
    if (shown.length === 2) marks.unshift(element("line", {x1: shown[0][0], y1: shown[0][1], x2: shown[1][0], y2: shown[1][1]}));
    byId("marks").replaceChildren(...marks);
    const lines = this.points.map(({place, label}) => {
      const name = !facts.labels ? "" : `${names[label] ?? "no class"} at `;
      return `${name}${place.map((v) => v.toFixed(3)).join(", ")} ${facts.unit}`;
    });
    if (this.points.length === 2) lines.push(`distance ${distance(this.points[0].place, this.points[1].place).toFixed(3)} ${facts.unit}`);
    byId("reading").textContent = lines.join("\n");
    byId("reading").hidden = lines.length === 0;
  }
}

async function open_page() {
  if (typeof DecompressionStream === "undefined") throw new Error("This browser is too old for this file: take one of 2023 or later.");
  const mesh = unpacked(await inflated(byId("mesh").textContent));
  byId("mesh").remove();
  window.semfield = new Page(new Drawing(mesh));
  document.body.dataset.state = "ready";
}
open_page().catch((error) => say_trouble(error.message));

// 4 x 4 matrices by columns, as WebGL takes them, and vectors as arrays of three.
const add = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / Math.hypot(...a));
const distance = (a, b) => Math.hypot(...add(a, b, -1));
/** A length in the scene's unit: to a millimetre in a room, and as fine in scenes of other sizes; `coarser` digits less. */
const length_text = (v, {low, high}, coarser = 0) =>
  v.toFixed(Math.min(20, Math.max(0, 3 - coarser - Math.floor(Math.log10(distance(low, high) || 1)))));

function product(a, b) {
  const out = new Array(16).fill(0);
  for (let column = 0; column < 4; ++column)
    for (let row = 0; row < 4; ++row)
      for (let k = 0; k < 4; ++k) out[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return out;
}

/** m (p, 1), divided by its last number. */
function moved(m, p) {
  const out = [0, 1, 2, 3].map((row) => m[row] * p[0] + m[4 + row] * p[1] + m[8 + row] * p[2] + m[12 + row]);
  return [out[0] / out[3], out[1] / out[3], out[2] / out[3], out[3]];
}

/** The rotation of a unit quaternion [x, y, z, w]. */
function rotation([x, y, z, w]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0, 0, 0, 0, 1];
}

const transposed = (m) => m.map((_, i) => m[4 * (i % 4) + Math.floor(i / 4)]);

function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
}

/** World to the axes of a camera at `eye` that looks along `forward`, with y up. */
function view_from(eye, forward) {
  const right = unit(cross(forward, [0, 1, 0])), up = cross(right, forward);
  return [right[0], up[0], -forward[0], 0, right[1], up[1], -forward[1], 0, right[2], up[2], -forward[2], 0,
    -dot(right, eye), -dot(up, eye), dot(forward, eye), 1];
}

// The mesh as it comes in the file, and its drawing: one call per scene and picture.
const canvas = document.getElementById("view");
const kMode = {photo: 0, class: 1, object: 2, entropy: 3, depth: 4};
const kReading = 10;         // the mode of read(), which draws numbers beside the screen
const kSlow_ms = 50;   // a picture that takes longer is drawn lighter while the camera moves
const kLightCells = 64;  // along each side, of which a light mesh keeps a vertex each
const kHidden = 0, kShown = 255, kChosen = 128;    // alpha of a palette's colour

// ---- the mesh

const bytes_of = (text) => Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** Sums of differences, in place. */
function summed(numbers) {
  for (let i = 1; i < numbers.length; ++i) numbers[i] += numbers[i - 1];
  return numbers;
}

/** corners [3 T] of triangles; place [V, 4]: steps along the box and the class; color [V, 4] with entropy; object [V]. */
function unpacked(buffer, facts) {
  const count = facts.vertices, corners = summed(new Uint32Array(buffer, 0, 3 * facts.triangles));
  let at = corners.byteLength;
  const part = (Kind) => {
    const numbers = new Kind(buffer.slice(at, at + Kind.BYTES_PER_ELEMENT * count));
    at += numbers.byteLength;
    return numbers;
  };
  const axes = [0, 1, 2].map(() => summed(part(Uint16Array)));
  const labels = part(Uint16Array), channels = [0, 1, 2].map(() => part(Uint8Array));
  const entropy = facts.labels ? part(Uint8Array) : new Uint8Array(count);
  const object = facts.objects.length > 0 ? part(Uint16Array) : new Uint16Array(count);
  const place = new Uint16Array(4 * count), color = new Uint8Array(4 * count);
  for (let v = 0; v < count; ++v) {
    for (let k = 0; k < 3; ++k) {
      place[4 * v + k] = axes[k][v];
      color[4 * v + k] = channels[k][v];
    }
    place[4 * v + 3] = labels[v];
    color[4 * v + 3] = entropy[v];
  }
  return {corners, place, color, object};
}

/** Corners of a lighter mesh of the same vertices: the first in each cell stands for all, and what shrinks to a line goes. */
function lightened({corners, place}) {
  const first = new Int32Array(kLightCells ** 3).fill(-1), stands_for = new Uint32Array(place.length / 4), kept = [];
  const cell = (steps) => steps * kLightCells >> 16;
  for (let v = 0; v < stands_for.length; ++v) {
    const at = cell(place[4 * v]) + kLightCells * (cell(place[4 * v + 1]) + kLightCells * cell(place[4 * v + 2]));
    if (first[at] < 0) first[at] = v;
    stands_for[v] = first[at];
  }
  for (let i = 0; i < corners.length; i += 3) {
    const [a, b, c] = [stands_for[corners[i]], stands_for[corners[i + 1]], stands_for[corners[i + 2]]];
    if (a !== b && b !== c && c !== a) kept.push(a, b, c);
  }
  return Uint32Array.from(kept);
}

// ---- drawing

const kVertex = `#version 300 es
layout(location = 0) in vec3 steps;
layout(location = 1) in vec4 photo;
layout(location = 2) in uint label;
layout(location = 3) in uint object;
uniform mat4 clip_from_world, eye_from_world;
uniform vec3 low, per_step;
out vec4 color;
out vec3 place;
flat out uint shown_label, shown_object;
void main() {
  vec4 world = vec4(low + steps * per_step, 1.0);
  gl_Position = clip_from_world * world;
  place = (eye_from_world * world).xyz;
  color = photo;
  shown_label = label;
  shown_object = object;
}`;
const kFragment = `#version 300 es
precision highp float;
precision highp int;
in vec4 color;
in vec3 place;
flat in uint shown_label, shown_object;
uniform int mode;
uniform uint classes;
uniform vec2 depths;                         // that the colours of depth span
uniform sampler2D palette, things, ramp;     // of each class, and one more for none; of each object, from 0: none
layout(location = 0) out vec4 pixel;         // depth, where numbers are drawn
layout(location = 1) out vec4 class_number;
layout(location = 2) out vec4 object_number;
vec4 in_bytes(uint n) { return vec4(float(n >> 16), float((n >> 8) & 255u), float(n & 255u), 255.0) / 255.0; }
vec3 ramped(float share) { return texelFetch(ramp, ivec2(int(clamp(share, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb; }
void main() {
  uint label = min(shown_label, classes);
  vec4 of_class = texelFetch(palette, ivec2(label, 0), 0), of_thing = texelFetch(things, ivec2(shown_object, 0), 0);
  if (of_class.a < 0.25 || of_thing.a < 0.25) discard;
  if (mode == 10) {
    pixel = in_bytes(uint(gl_FragCoord.z * 16777215.0));
    class_number = in_bytes(label);
    object_number = in_bytes(shown_object);
    return;
  }
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.55 + 0.45 * abs(normal.z);
  vec3 shown = color.rgb;
  if (mode == 1) shown = of_class.rgb * light;
  if (mode == 2) shown = (shown_object == 0u ? 0.35 * vec3(dot(color.rgb, vec3(0.3, 0.6, 0.1))) + 0.12 : of_thing.rgb) * light;
  if (mode == 3) shown = ramped(color.a);
  if (mode == 4) shown = ramped((depths.y + place.z) / (depths.y - depths.x));
  if (of_thing.a < 0.75) shown = mix(shown, vec3(1.0, 0.84, 0.29), 0.45);
  pixel = vec4(shown, 1.0);
}`;

/** One mesh on the graphics device, with the colours of its classes and objects. */
class Layer {
  constructor(drawing, facts, mesh) {
    const gl = drawing.gl;
    Object.assign(this, {drawing, facts, mesh, vertices: mesh.object.length, depth_range: [0, 1]});
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    this.buffer(gl.ARRAY_BUFFER, mesh.place);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, 8, 0);
    gl.vertexAttribIPointer(2, 1, gl.UNSIGNED_SHORT, 8, 6);
    this.buffer(gl.ARRAY_BUFFER, mesh.color);
    gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 4, 0);
    this.object_buffer = this.buffer(gl.ARRAY_BUFFER, mesh.object);
    gl.vertexAttribIPointer(3, 1, gl.UNSIGNED_SHORT, 2, 0);
    for (const index of [0, 1, 2, 3]) gl.enableVertexAttribArray(index);
    this.fine = {buffer: this.buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.corners), count: mesh.corners.length};
    const colors = facts.classes.map((one) => one.color);
    this.classes = this.palette([...colors, [150, 150, 150]]);
    this.set_objects(facts.objects);
  }
  buffer(kind, data) {
    const gl = this.drawing.gl, made = gl.createBuffer();
    gl.bindBuffer(kind, made);
    gl.bufferData(kind, data, gl.STATIC_DRAW);
    return made;
  }
  palette(colors) {
    const bytes = new Uint8Array(4 * colors.length).fill(kShown);
    colors.forEach((color, i) => bytes.set(color, 4 * i));
    const made = {texture: this.drawing.texture(), bytes};
    this.drawing.send(made);
    return made;
  }
  /** `ids` [vertices] where they changed. */
  set_objects(objects, ids) {
    const gl = this.drawing.gl, colors = [[150, 150, 150]];
    for (let id = 1; id <= Math.max(0, ...objects.map((o) => o.id)); ++id) colors.push([150, 150, 150]);
    for (const one of objects) colors[one.id] = one.color;
    if (this.things) gl.deleteTexture(this.things.texture);
    this.things = this.palette(colors);
    if (ids) this.fill(this.object_buffer, ids);
  }
  fill(buffer, data) {
    const gl = this.drawing.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  }
  /** `palette`: classes or things; `alpha`: kHidden, kShown or kChosen. */
  mark(palette, entry, alpha) {
    palette.bytes[4 * entry + 3] = alpha;
    this.drawing.send(palette);
  }
  /** Binds the triangles to draw, with the layer's array bound; their number of corners. */
  triangles(light) {
    const gl = this.drawing.gl;
    if (light && !this.light) {
      const corners = lightened(this.mesh);
      this.light = {buffer: this.buffer(gl.ELEMENT_ARRAY_BUFFER, corners), count: corners.length};
    }
    const {buffer, count} = light ? this.light : this.fine;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    return count;
  }
  drop() { this.drawing.gl.deleteVertexArray(this.array); }
}

class Drawing {
  constructor(ramp) {
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
    this.at = new Map();
    ["palette", "things", "ramp"].forEach((name, unit) => gl.uniform1i(this.place(name), unit));
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const colors = new Uint8Array(4 * 256).fill(255);
    for (let i = 0; i < 256; ++i) colors.set(ramp.slice(3 * i, 3 * i + 3), 4 * i);
    this.ramp = {texture: this.texture(), bytes: colors};
    this.send(this.ramp);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);  // a room seen from outside is open
    this.target = gl.createFramebuffer();
    this.calls = 0;
    this.slow = false;
  }
  place(name) {
    if (!this.at.has(name)) this.at.set(name, this.gl.getUniformLocation(this.program, name));
    return this.at.get(name);
  }
  texture() {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return made;
  }
  send({texture, bytes}) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, bytes.length / 4, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  }
  clear(background) {
    const gl = this.gl;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }
  draw_layer(layer, mode, matrices, light = false) {
    const gl = this.gl, {low, high, classes} = layer.facts;
    gl.bindVertexArray(layer.array);
    [layer.classes, layer.things, this.ramp].forEach((one, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, one.texture);
    });
    gl.uniform3fv(this.place("low"), low);
    gl.uniform3fv(this.place("per_step"), high.map((h, i) => (h - low[i]) / 65535));
    gl.uniform1ui(this.place("classes"), classes.length);
    gl.uniform2fv(this.place("depths"), layer.depth_range);
    gl.uniformMatrix4fv(this.place("clip_from_world"), false, matrices.clip);
    gl.uniformMatrix4fv(this.place("eye_from_world"), false, matrices.eye);
    gl.uniform1i(this.place("mode"), mode);
    gl.drawElements(gl.TRIANGLES, layer.triangles(light), gl.UNSIGNED_INT, 0);
    ++this.calls;
  }
  draw(layer, mode, matrices, light = false) {
    this.clear([0.082, 0.094, 0.11, 1]);
    this.draw_layer(layer, mode, matrices, light);
  }
  /** draw() of whole meshes, waited for: is it slow? */
  draw_fine(...what) {
    const begin = performance.now();
    this.draw(...what);
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.slow = performance.now() - begin > kSlow_ms;
  }
  /** [depth in 24 bits, class, object] at a pixel from below, drawn beside the screen; null where nothing is. */
  read(layer, matrices, x, y) {
    const gl = this.gl, numbers = [0, 1, 2].map((i) => gl.COLOR_ATTACHMENT0 + i), out = new Uint8Array(4);
    const kinds = [...numbers.map((at) => [gl.RGBA8, at]), [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    const buffers = kinds.map(([format, at]) => {
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, canvas.width, canvas.height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, at, gl.RENDERBUFFER, buffer);
      return buffer;
    });
    gl.drawBuffers(numbers);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, y, 1, 1);
    this.clear([0, 0, 0, 0]);
    this.draw_layer(layer, kReading, matrices);
    const found = numbers.map((at) => {
      gl.readBuffer(at);
      gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, out);
      return out[3] === 0 ? null : out[0] * 65536 + out[1] * 256 + out[2];
    });
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    for (const buffer of buffers) gl.deleteRenderbuffer(buffer);
    return found.includes(null) ? null : found;
  }
}

// The mesh of a scene as it comes from the program, and its drawing: one call per scene and picture.
import {distance} from './camera.js';
import {kRamp} from './dom.js';

export const kMode = {photo: 0, class: 1, object: 2, entropy: 3, depth: 4};
const kReading = 10;     // the mode of read(), which draws numbers beside the screen
const kSlow_ms = 50;     // a picture that takes longer is drawn lighter while the camera moves
const kLightCells = 64;  // along each side, of which a light mesh keeps a vertex each
export const [kHidden, kShown, kChosen] = [0, 255, 128];  // alpha of a palette's colour
export const kGrey = [150, 150, 150];                     // what has no class or object

/// A length in the scene's unit: to a millimetre in a room, and as fine in scenes of other sizes; `coarser` digits less.
export const lengthText = (v, {low, high}, coarser = 0) =>
  v.toFixed(Math.min(20, Math.max(0, 3 - coarser - Math.floor(Math.log10(distance(low, high) || 1)))));

export const bytesOf = (text) => Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));

export async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Response(stream).arrayBuffer();
}

/// Sums of differences, in place.
function summed(numbers) {
  for (let i = 1; i < numbers.length; ++i) numbers[i] += numbers[i - 1];
  return numbers;
}

/// corners [3 T] of triangles; place [V, 4]: steps along the box and the class; normal [V, 4], with 127 for 1; color [V, 4] with entropy; object [V].
export function unpacked(buffer, facts) {
  const count = facts.vertices;
  const corners = summed(new Uint32Array(buffer, 0, 3 * facts.triangles));
  let at = corners.byteLength;
  const part = (Kind) => {
    const numbers = new Kind(buffer.slice(at, at + Kind.BYTES_PER_ELEMENT * count));
    at += numbers.byteLength;
    return numbers;
  };
  const axes = [0, 1, 2].map(() => summed(part(Uint16Array)));
  const normals = [0, 1, 2].map(() => part(Int8Array));
  const labels = part(Uint16Array);
  const channels = [0, 1, 2].map(() => part(Uint8Array));
  const entropy = facts.labels ? part(Uint8Array) : new Uint8Array(count);
  const object = facts.objects.length > 0 ? part(Uint16Array) : new Uint16Array(count);
  const [place, normal, color] = [Uint16Array, Int8Array, Uint8Array].map((Kind) => new Kind(4 * count));
  for (let v = 0; v < count; ++v) {
    for (let k = 0; k < 3; ++k) {
      place[4 * v + k] = axes[k][v];
      normal[4 * v + k] = normals[k][v];
      color[4 * v + k] = channels[k][v];
    }
    place[4 * v + 3] = labels[v];
    color[4 * v + 3] = entropy[v];
  }
  return {corners, place, normal, color, object};
}

/// Corners of a lighter mesh of the same vertices: the first in each cell stands for all, and what shrinks to a line goes.
function lightened({corners, place}) {
  const first = new Int32Array(kLightCells ** 3).fill(-1);
  const standsFor = new Uint32Array(place.length / 4);
  const left = [];
  const cell = (steps) => steps * kLightCells >> 16;
  for (let v = 0; v < standsFor.length; ++v) {
    const at = cell(place[4 * v]) + kLightCells * (cell(place[4 * v + 1]) + kLightCells * cell(place[4 * v + 2]));
    if (first[at] < 0) first[at] = v;
    standsFor[v] = first[at];
  }
  for (let i = 0; i < corners.length; i += 3) {
    const [a, b, c] = [standsFor[corners[i]], standsFor[corners[i + 1]], standsFor[corners[i + 2]]];
    if (a !== b && b !== c && c !== a) left.push(a, b, c);
  }
  return Uint32Array.from(left);
}

const kVertex = `#version 300 es
layout(location = 0) in vec3 steps;
layout(location = 1) in vec4 photo;
layout(location = 2) in uint label;
layout(location = 3) in uint object;
layout(location = 4) in vec3 normal;
uniform mat4 clip_from_world, eye_from_world;
uniform vec3 low, per_step;
out vec4 color;
out vec3 place, facing;
flat out uint shown_label, shown_object;
void main() {
  vec4 world = vec4(low + steps * per_step, 1.0);
  gl_Position = clip_from_world * world;
  place = (eye_from_world * world).xyz;
  facing = mat3(eye_from_world) * normal;
  color = photo;
  shown_label = label;
  shown_object = object;
}`;
const kFragment = `#version 300 es
precision highp float;
precision highp int;
in vec4 color;
in vec3 place, facing;
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
  float light = 0.55 + 0.45 * abs(normalize(facing).z);
  vec3 shown = color.rgb;
  if (mode == 1) shown = of_class.rgb * light;
  if (mode == 2) shown = (shown_object == 0u ? 0.35 * vec3(dot(color.rgb, vec3(0.3, 0.6, 0.1))) + 0.12 : of_thing.rgb) * light;
  if (mode == 3) shown = ramped(color.a);
  if (mode == 4) shown = ramped((depths.y + place.z) / (depths.y - depths.x));
  if (of_thing.a < 0.75) shown = mix(shown, vec3(1.0, 0.84, 0.29), 0.45);
  pixel = vec4(shown, 1.0);
}`;

/// One mesh on the graphics device, with the colours of its classes and objects.
export class Layer {
  constructor(drawing, facts, mesh) {
    const {gl} = drawing;
    Object.assign(this, {drawing, facts, mesh, depthRange: [0, 1]});
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    this.buffer(gl.ARRAY_BUFFER, mesh.place);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, 8, 0);
    gl.vertexAttribIPointer(2, 1, gl.UNSIGNED_SHORT, 8, 6);
    this.buffer(gl.ARRAY_BUFFER, mesh.color);
    gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 4, 0);
    this.objectBuffer = this.buffer(gl.ARRAY_BUFFER, mesh.object);
    gl.vertexAttribIPointer(3, 1, gl.UNSIGNED_SHORT, 2, 0);
    this.buffer(gl.ARRAY_BUFFER, mesh.normal);
    gl.vertexAttribPointer(4, 3, gl.BYTE, true, 4, 0);
    for (const index of [0, 1, 2, 3, 4]) gl.enableVertexAttribArray(index);
    this.fine = {buffer: this.buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.corners), count: mesh.corners.length};
    this.classes = this.palette([...facts.classes.map(({color}) => color), kGrey]);
    this.setObjects(facts.objects);
  }
  buffer(kind, data) {
    const {gl} = this.drawing;
    const made = gl.createBuffer();
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
  /// `ids` [vertices] where they changed.
  setObjects(objects, ids) {
    const {gl} = this.drawing;
    const colors = Array.from({length: 1 + Math.max(0, ...objects.map(({id}) => id))}, () => kGrey);
    for (const {id, color} of objects) colors[id] = color;
    if (this.things) gl.deleteTexture(this.things.texture);
    this.things = this.palette(colors);
    if (!ids) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.objectBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, ids, gl.STATIC_DRAW);
  }
  /// `palette`: classes or things; `alpha`: kHidden, kShown or kChosen.
  mark(palette, entry, alpha) {
    palette.bytes[4 * entry + 3] = alpha;
    this.drawing.send(palette);
  }
  /// Binds the triangles to draw, with the layer's array bound; their number of corners.
  triangles(light) {
    const {gl} = this.drawing;
    if (light && !this.light) {
      const corners = lightened(this.mesh);
      this.light = {buffer: this.buffer(gl.ELEMENT_ARRAY_BUFFER, corners), count: corners.length};
    }
    const {buffer, count} = light ? this.light : this.fine;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    return count;
  }
  /// [place, normal] of about 2,000 vertices.
  points() {
    const {place, normal} = this.mesh;
    const {low, high} = this.facts;
    const three = [0, 1, 2];
    const stride = 4 * Math.ceil(place.length / 8000);
    const from = Array.from({length: Math.floor(place.length / (stride || 4))}, (_, i) => i * stride);
    return from.map((at) => [three.map((k) => low[k] + place[at + k] * (high[k] - low[k]) / 65535), three.map((k) => normal[at + k])]);
  }
  drop() { this.drawing.gl.deleteVertexArray(this.array); }
}

export class Drawing {
  constructor(canvas) {
    const gl = this.gl = canvas.getContext('webgl2', {antialias: true, preserveDrawingBuffer: true});
    if (gl === null) throw new Error('This browser has no WebGL 2: take a newer one, or switch hardware acceleration on.');
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
    const names = Array.from({length: gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS)}, (_, i) => gl.getActiveUniform(this.program, i).name);
    this.at = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(this.program, name)]));
    ['palette', 'things', 'ramp'].forEach((name, unit) => gl.uniform1i(this.at[name], unit));
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.ramp = {texture: this.texture(), bytes: Uint8Array.from(kRamp.flatMap((color) => [...color, 255]))};
    this.send(this.ramp);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);  // a room seen from outside is open
    this.target = gl.createFramebuffer();
    this.calls = 0;
    this.isSlow = false;
  }
  texture() {
    const {gl} = this;
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return made;
  }
  send({texture, bytes}) {
    const {gl} = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, bytes.length / 4, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  }
  clear(background) {
    const {gl} = this;
    gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
    gl.clearColor(...background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }
  drawLayer(layer, mode, matrices, light = false) {
    const {gl} = this;
    const {low, high, classes} = layer.facts;
    gl.bindVertexArray(layer.array);
    [layer.classes, layer.things, this.ramp].forEach((one, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, one.texture);
    });
    gl.uniform3fv(this.at.low, low);
    gl.uniform3fv(this.at.per_step, high.map((h, i) => (h - low[i]) / 65535));
    gl.uniform1ui(this.at.classes, classes.length);
    gl.uniform2fv(this.at.depths, layer.depthRange);
    gl.uniformMatrix4fv(this.at.clip_from_world, false, matrices.clip);
    gl.uniformMatrix4fv(this.at.eye_from_world, false, matrices.eye);
    gl.uniform1i(this.at.mode, mode);
    gl.drawElements(gl.TRIANGLES, layer.triangles(light), gl.UNSIGNED_INT, 0);
    ++this.calls;
  }
  draw(layer, mode, matrices, light = false) {
    this.clear([0.082, 0.094, 0.11, 1]);
    this.drawLayer(layer, mode, matrices, light);
  }
  /// draw() of whole meshes, waited for: is it slow?
  drawFine(...what) {
    const begin = performance.now();
    this.draw(...what);
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.isSlow = performance.now() - begin > kSlow_ms;
  }
  /// [depth in 24 bits, class, object] at a pixel from below, drawn beside the screen; null where nothing is.
  read(layer, matrices, x, y) {
    const {gl} = this;
    const numbers = [0, 1, 2].map((i) => gl.COLOR_ATTACHMENT0 + i);
    const out = new Uint8Array(4);
    const kinds = [...numbers.map((at) => [gl.RGBA8, at]), [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    const buffers = kinds.map(([format, at]) => {
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, gl.canvas.width, gl.canvas.height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, at, gl.RENDERBUFFER, buffer);
      return buffer;
    });
    gl.drawBuffers(numbers);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, y, 1, 1);
    this.clear([0, 0, 0, 0]);
    this.drawLayer(layer, kReading, matrices);
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

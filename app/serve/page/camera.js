// Cameras: of a picture that lies on the screen, and of a scene in three dimensions. Each has `screen`, {width, height} in CSS pixels and `ratio`, of the
// device's pixels to them; resize(screen); fit(), which shows all; move(dx, dy) and zoom(factor, x, y) in CSS pixels.

const kMargin = 8;
const kMostZoom = 40;

// `port` is where an image lies on the screen: scale, screen pixels per image pixel, and (x, y), the screen's point of the image's upper left corner.
export const toImage = (port, x, y) => [(x - port.x) / port.scale, (y - port.y) / port.scale];
export const toScreen = (port, x, y) => [port.x + x * port.scale, port.y + y * port.scale];
export const isInside = (image, x, y) => x >= 0 && y >= 0 && x < image.width && y < image.height;

export class PictureCamera {
  constructor() {
    this.screen = {width: 1, height: 1, ratio: 1};
    this.image = {width: 1, height: 1};
    this.fit();
  }

  /// A picture that was fitted stays so.
  resize(screen) {
    const wasFitted = this.port.scale <= this.fitted.scale * 1.001;
    this.screen = screen;
    if (wasFitted) this.fit();
  }

  /// The image's size; another one is fitted.
  setImage(width, height) {
    if (this.image.width === width && this.image.height === height) return;
    this.image = {width, height};
    this.fit();
  }

  get fitted() {
    const {image, screen} = this;
    const scale = Math.max(1e-6, Math.min((screen.width - 2 * kMargin) / image.width, (screen.height - 2 * kMargin) / image.height));
    return {scale, x: (screen.width - scale * image.width) / 2, y: (screen.height - scale * image.height) / 2};
  }
  fit() { this.port = this.fitted; }

  /// The image's middle third never leaves the screen.
  look({scale, x, y}) {
    const within = (at, length, most) => Math.min(Math.max(at, most / 3 - scale * length), (most * 2) / 3);
    this.port = {scale, x: within(x, this.image.width, this.screen.width), y: within(y, this.image.height, this.screen.height)};
  }
  move(dx, dy) { this.look({...this.port, x: this.port.x + dx, y: this.port.y + dy}); }

  /// The image's point under (x, y) stays there. Never smaller than fitted.
  zoom(factor, x = this.screen.width / 2, y = this.screen.height / 2) {
    const least = this.fitted.scale;
    const scale = Math.min(Math.max(this.port.scale * factor, least), Math.max(kMostZoom, least));
    const ratio = scale / this.port.scale;
    if (scale <= least * 1.001) this.fit();
    else this.look({scale, x: x - (x - this.port.x) * ratio, y: y - (y - this.port.y) * ratio});
  }
}

// 4 x 4 matrices by columns, as WebGL takes them, and vectors as arrays of three.

export const add = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / Math.hypot(...a));
export const distance = (a, b) => Math.hypot(...add(a, b, -1));

const product = (a, b) => Array.from({length: 16}, (_, i) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + i % 4] * b[i - i % 4 + k], 0));

/// m (p, 1), divided by its last number.
export function moved(m, p) {
  const out = [0, 1, 2, 3].map((row) => m[row] * p[0] + m[4 + row] * p[1] + m[8 + row] * p[2] + m[12 + row]);
  return [out[0] / out[3], out[1] / out[3], out[2] / out[3], out[3]];
}

/// The rotation of a unit quaternion [x, y, z, w].
function rotation([x, y, z, w]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
          2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
          2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0, 0, 0, 0, 1];
}

function perspective(slope, aspect, near, far) {
  const f = 1 / slope;
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
}

const kNear = 0.002;  // of the scene's diagonal
const kFar = 6;
const kSlope = [Math.tan(25 * Math.PI / 180), Math.tan(27.5 * Math.PI / 180)];  // of half a picture, across and up: at least

/// Turns about a target, upright, in the scene turned to y up.
export class OrbitCamera {
  constructor(facts) {
    this.turnToY = rotation(facts.turn);
    Object.assign(this, {eyeInside: facts.eye, aheadInside: facts.ahead});
    this.setBox(facts);
    this.screen = {width: 1, height: 1, ratio: 1};
    this.fit();
  }

  resize(screen) { this.screen = screen; }

  /// {low, high}: what the scene lies in; points: [place, normal] of some of its surface.
  setBox(box, points = []) {
    Object.assign(this, {box, points});
    this.diagonal = distance(box.low, box.high);
    this.middle = box.low.map((v, i) => (v + box.high[i]) / 2);
  }

  /// Outside of the scene; what of it faces the camera fills `free`, {left, top, right, bottom} in CSS pixels.
  fit(free = {left: 0, top: 0, right: this.screen.width, bottom: this.screen.height}) {
    const [x, , z] = moved(this.turnToY, this.aheadInside ?? [0, 0, 0]);
    Object.assign(this, {target: moved(this.turnToY, this.middle).slice(0, 3), yaw: this.aheadInside ? Math.atan2(-x, -z) + 0.4 : 0.7, pitch: 0.65});
    const {right, up, forward} = this.axes;
    const {width, height} = this.screen;
    const perPixel = 2 * this.slope / height;
    const facing = this.points.filter(([, normal]) => dot(moved(this.turnToY, normal).slice(0, 3), forward) < 0).map(([place]) => place);
    const corners = Array.from({length: 8}, (_, k) => [0, 1, 2].map((i) => this.box[k >> i & 1 ? 'high' : 'low'][i]));
    const places = (facing.length > 0 ? facing : corners).map((place) => add(moved(this.turnToY, place).slice(0, 3), this.target, -1));
    const ways = [[right, free.left - width / 2, free.right - width / 2], [up, height / 2 - free.bottom, height / 2 - free.top]].map(([axis, from, to]) => {
      // Aside by `a`, a place at (r, f) of the axes is seen where low (reach + f) <= r - a <= high (reach + f).
      const [low, high] = [from * perPixel, to * perPixel];
      const bounds = (end) => places.map((place) => dot(place, axis) - end * dot(place, forward));
      return {low, high, least: Math.max(...bounds(high)), most: Math.min(...bounds(low))};
    });
    this.reach = 1.06 * Math.max(...ways.map(({low, high, least, most}) => (least - most) / (high - low)));
    this.aside = ways.map(({low, high, least, most}) => (least + most) / 2 / this.reach - (low + high) / 2);
  }
  /// As the training camera that sees most.
  goInside() {
    const [x, y, z] = moved(this.turnToY, this.aheadInside);
    this.target = moved(this.turnToY, this.eyeInside).slice(0, 3);
    this.yaw = Math.atan2(-x, -z);
    this.pitch = -Math.asin(Math.max(-1, Math.min(1, y)));
    this.reach = 1e-3 * this.diagonal;
    this.aside = [0, 0];
  }
  /// Turns about a place of the world, from near enough to fill half of the picture with `size`.
  lookAt(place, size) {
    this.target = moved(this.turnToY, place).slice(0, 3);
    this.reach = Math.max(0.03 * this.diagonal, Math.min(this.reach, size / this.slope));
  }
  get isInside() { return this.reach < 0.05 * this.diagonal; }

  get axes() {
    const c = Math.cos(this.pitch);
    const forward = [-Math.sin(this.yaw) * c, -Math.sin(this.pitch), -Math.cos(this.yaw) * c];
    const right = unit(cross(forward, [0, 1, 0]));
    return {right, up: cross(right, forward), forward};
  }
  turn(dx, dy) {
    const near = this.isInside ? -1 : 1;  // inside, the picture follows the hand
    this.yaw -= near * dx * 0.006;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + near * dy * 0.006));
  }
  move(dx, dy) {
    const {right, up} = this.axes;
    const perPixel = 2 * Math.max(this.reach, 0.15 * this.diagonal) * this.slope / this.screen.height;
    this.target = add(add(this.target, right, -dx * perPixel), up, dy * perPixel);
  }
  /// Shares of the diagonal to the right, up and ahead.
  fly(right, up, ahead) {
    const {axes, diagonal} = this;
    this.target = add(add(add(this.target, axes.right, right * diagonal), [0, 1, 0], up * diagonal), axes.forward, ahead * diagonal);
  }
  /// Closer to the target, or through it where it is near already.
  zoom(factor) {
    const least = 0.02 * this.diagonal;
    if (this.reach / factor > least && this.reach > least) this.reach = Math.min(4 * this.diagonal, this.reach / factor);
    else this.target = add(this.target, this.axes.forward, (1 - 1 / factor) * 0.2 * this.diagonal);
  }
  /// aside: how far the eye stands to the right and above, in shares of its reach.
  state() { return {target: [...this.target], yaw: this.yaw, pitch: this.pitch, reach: this.reach, aside: [...this.aside]}; }

  get aspect() { return this.screen.width / this.screen.height; }
  get slope() { return Math.max(kSlope[1], kSlope[0] / this.aspect); }
  matrices() {
    const {right, up, forward} = this.axes;
    const at = add(add(add(this.target, forward, -this.reach), right, this.aside[0] * this.reach), up, this.aside[1] * this.reach);
    const turned = [0, 1, 2].flatMap((k) => [right[k], up[k], -forward[k], 0]);
    const eye = product([...turned, -dot(right, at), -dot(up, at), dot(forward, at), 1], this.turnToY);
    return {clip: product(perspective(this.slope, this.aspect, kNear * this.diagonal, kFar * this.diagonal), eye), eye};
  }
  /// Degrees of the picture's width.
  fovDeg() { return 360 / Math.PI * Math.atan(this.slope * this.aspect); }
  /// Nearest and farthest depth of what is worth colours.
  depths() {
    const half = 0.55 * this.diagonal;
    return this.isInside ? [0, half] : [Math.max(0, this.reach - half), this.reach + half];
  }
  /// Rows of world_from_camera [3, 4], x right, y down, z ahead.
  worldFromCamera() {
    const m = this.matrices().eye;  // its rows are the axes right, up and backward
    return [0, 1, 2].map((k) => [m[4 * k], -m[4 * k + 1], -m[4 * k + 2], -dot(m.slice(4 * k, 4 * k + 3), m.slice(12, 15))]);
  }
  get place() { return this.worldFromCamera().map((row) => row[3]); }

  /// The point of the screen of a place in the input's world, or null behind the eye.
  toScreen(place) {
    const [x, y, , ahead] = moved(this.matrices().clip, place);
    return ahead > 0 ? [(x + 1) / 2 * this.screen.width, (1 - y) / 2 * this.screen.height] : null;
  }
  /// The place in the input's world behind a point of the screen, at a depth of 0 to 1.
  unprojected(x, y, depth) {
    const [near, far] = [kNear * this.diagonal, kFar * this.diagonal];
    const z = 2 * far * near / (far + near - (2 * depth - 1) * (far - near));
    const half = z * this.slope;
    const at = [(2 * x / this.screen.width - 1) * half * this.aspect, (2 * y / this.screen.height - 1) * half, z];
    return this.worldFromCamera().map((row) => dot(row.slice(0, 3), at) + row[3]);
  }
}

/// Between two states of a camera, at 0 to 1 of the way.
export function between(a, b, share) {
  const s = share * share * (3 - 2 * share);
  const mix = (x, y) => x + s * (y - x);
  const around = Math.atan2(Math.sin(b.yaw - a.yaw), Math.cos(b.yaw - a.yaw));  // the short way
  return {target: a.target.map((v, i) => mix(v, b.target[i])), yaw: a.yaw + s * around, pitch: mix(a.pitch, b.pitch),
          reach: Math.exp(mix(Math.log(a.reach), Math.log(b.reach))), aside: a.aside.map((v, i) => mix(v, b.aside[i]))};
}

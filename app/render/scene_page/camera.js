// The camera: it turns about a target, upright, in the scene turned to y up.
const kNear = 0.002, kFar = 6;  // of the scene's diagonal
const kAngle = 55 * Math.PI / 180;

class OrbitCamera {
  constructor(facts) {
    this.turn_to_y = rotation(facts.turn);
    this.diagonal = distance(facts.low, facts.high);
    this.middle = facts.low.map((v, i) => (v + facts.high[i]) / 2);
    this.inner = facts.eye;
    this.outside();
  }
  outside() {
    this.target = moved(this.turn_to_y, this.middle).slice(0, 3);
    this.yaw = 0.7;
    this.pitch = 0.65;
    this.reach = 1.15 * this.diagonal * Math.max(1, 0.8 * canvas.clientHeight / Math.max(canvas.clientWidth, 1));
  }
  inside() {
    this.target = moved(this.turn_to_y, this.inner).slice(0, 3);
    this.pitch = 0.1;
    this.reach = 1e-3 * this.diagonal;
  }
  /** Turns about a place of the world, from near enough to fill half of the picture with `size`. */
  look_at(place, size) {
    this.target = moved(this.turn_to_y, place).slice(0, 3);
    this.reach = Math.max(0.03 * this.diagonal, Math.min(this.reach, size / Math.tan(kAngle / 2)));
  }
  is_inside() { return this.reach < 0.05 * this.diagonal; }
  forward() {
    const c = Math.cos(this.pitch);
    return [-Math.sin(this.yaw) * c, -Math.sin(this.pitch), -Math.cos(this.yaw) * c];
  }
  eye() { return add(this.target, this.forward(), -this.reach); }
  turn(dx, dy) {
    const near = this.is_inside() ? -1 : 1;  // inside, the picture follows the hand
    this.yaw -= near * dx * 0.006;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + near * dy * 0.006));
  }
  /** Pixels of the picture. */
  move(dx, dy) {
    const forward = this.forward(), right = unit(cross(forward, [0, 1, 0])), up = cross(right, forward);
    const per_pixel = 2 * Math.max(this.reach, 0.15 * this.diagonal) * Math.tan(kAngle / 2) / canvas.clientHeight;
    this.target = add(add(this.target, right, -dx * per_pixel), up, dy * per_pixel);
  }
  /** Shares of the diagonal to the right, up and ahead. */
  fly(right, up, ahead) {
    const forward = this.forward(), side = unit(cross(forward, [0, 1, 0]));
    this.target = add(add(add(this.target, side, right * this.diagonal), [0, 1, 0], up * this.diagonal), forward, ahead * this.diagonal);
  }
  closer(factor) {
    if (this.reach * factor > 0.02 * this.diagonal && this.reach > 0.02 * this.diagonal) {
      this.reach = Math.min(4 * this.diagonal, this.reach * factor);
    } else {
      this.target = add(this.target, this.forward(), (1 - factor) * 0.2 * this.diagonal);
    }
  }
  state() { return {target: [...this.target], yaw: this.yaw, pitch: this.pitch, reach: this.reach}; }
  matrices() {
    const eye_from_world = product(view_from(this.eye(), this.forward()), this.turn_to_y);
    const aspect = canvas.width / canvas.height;
    const projection = perspective(kAngle, aspect, kNear * this.diagonal, kFar * this.diagonal);
    return {clip: product(projection, eye_from_world), eye: eye_from_world, aspect};
  }
  /** Degrees of the picture's width. */
  fov_deg() { return 360 / Math.PI * Math.atan(Math.tan(kAngle / 2) * canvas.width / canvas.height); }
  /** Nearest and farthest depth of what is worth colours. */
  depths() {
    const half = 0.55 * this.diagonal;
    return this.is_inside() ? [0, half] : [Math.max(0, this.reach - half), this.reach + half];
  }
  /** Rows of world_from_camera [3, 4], x right, y down, z ahead. */
  world_from_camera() {
    const m = this.matrices().eye;  // its rows are the axes right, up and backward
    const at = [0, 1, 2].map((k) => -(m[4 * k] * m[12] + m[4 * k + 1] * m[13] + m[4 * k + 2] * m[14]));
    return [0, 1, 2].map((k) => [m[4 * k], -m[4 * k + 1], -m[4 * k + 2], at[k]]);
  }
  /** The place in the input's world behind a pixel (x from the left, y from below) at a depth of 0 to 1. */
  unprojected(x, y, depth) {
    const matrices = this.matrices(), near = kNear * this.diagonal, far = kFar * this.diagonal, ndc = 2 * depth - 1;
    const z = 2 * far * near / (far + near - ndc * (far - near)), half = Math.tan(kAngle / 2);
    const at = [(2 * x / canvas.width - 1) * half * matrices.aspect * z, (2 * y / canvas.height - 1) * half * z, -z];
    const m = matrices.eye, back = transposed([...m.slice(0, 3), 0, ...m.slice(4, 7), 0, ...m.slice(8, 11), 0, 0, 0, 0, 1]);
    return moved(back, add(at, m.slice(12, 15), -1)).slice(0, 3);
  }
}

/** Between two states of a camera, at 0 to 1 of the way. */
function between(a, b, share) {
  const s = share * share * (3 - 2 * share), mix = (x, y) => x + s * (y - x);
  const around = Math.atan2(Math.sin(b.yaw - a.yaw), Math.cos(b.yaw - a.yaw));  // the short way
  return {target: a.target.map((v, i) => mix(v, b.target[i])), yaw: a.yaw + s * around, pitch: mix(a.pitch, b.pitch),
    reach: Math.exp(mix(Math.log(a.reach), Math.log(b.reach)))};
}

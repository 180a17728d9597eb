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


// The free camera: where it is, how keys and the pointer move it, and which pictures it requests.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const unit = (a) => a.map((v) => v / Math.max(1e-12, Math.hypot(...a)));
const column = (rotation, c) => [rotation[c], rotation[3 + c], rotation[6 + c]];
/// v turned about the unit vector k by an angle.
const turned = (v, k, angle) => {
  const [c, s, d] = [Math.cos(angle), Math.sin(angle), dot(k, v) * (1 - Math.cos(angle))];
  const side = cross(k, v);
  return v.map((value, i) => value * c + side[i] * s + k[i] * d);
};

/// What is above for people who took these pictures: the mean of the cameras' upper sides. Cameras: OpenCV axes, row-major.
export function upOf(cameras) {
  const sum = cameras.reduce((total, {rotation}) => plus(total, column(rotation, 1), -1), [0, 0, 0]);
  return Math.hypot(...sum) > 1e-3 * cameras.length ? unit(sum) : column(cameras[0].rotation, 1).map((v) => -v);
}

/// A length that a step of a second may have: a third of the mean distance of the cameras from their centre.
export function paceOf(cameras) {
  const centre = cameras.reduce((total, {position}) => plus(total, position, 1 / cameras.length), [0, 0, 0]);
  const spread = cameras.reduce((total, {position}) => total + Math.hypot(...plus(position, centre, -1)), 0) / cameras.length;
  return spread > 0 ? spread / 3 : 0.5;
}

export class FreeCamera {
  constructor({position, rotation, fov_deg}, up) {
    Object.assign(this, {position, fov_deg, up, forward: unit(column(rotation, 2))});
  }

  get right() { return unit(cross(this.forward, this.up)); }

  /// Radians to the right and upwards; never upside down.
  turn(right, upwards) {
    this.forward = unit(turned(this.forward, this.up, -right));
    const pitch = Math.asin(Math.max(-1, Math.min(1, dot(this.forward, this.up))));
    const angle = Math.max(-1.5, Math.min(1.5, pitch + upwards)) - pitch;
    this.forward = unit(turned(this.forward, this.right, angle));
  }

  /// Lengths along the camera's right, the scene's up and where it looks.
  move(right, upwards, ahead) {
    this.position = plus(plus(plus(this.position, this.right, right), this.up, upwards), this.forward, ahead);
  }

  /// As the program wants it.
  get value() {
    const x = this.right;
    const z = this.forward;
    const y = cross(z, x);
    return {position: this.position, rotation: [0, 1, 2].flatMap((row) => [x[row], y[row], z[row]]), fov_deg: this.fov_deg};
  }
}

const kStill_ms = 250;
const kSizes = {least: 96, first: 192, most: 480};

/// A flight: keys held, the camera, and pictures small while it moves and full when it stands.
export class Flight {
  /// changed(picture) shows one; trouble(error).
  constructor({channel, camera, pace, fullSize_px, withColor, changed, trouble}) {
    Object.assign(this, {channel, camera, pace, fullSize_px, withColor, changed, trouble});
    this.held = new Set();
    this.size_px = kSizes.first;
    this.moved_ms = performance.now() - kStill_ms;
    this.dirty = true;      // the newest place was not requested
    this.fulls = 0;         // how many of the full pictures were requested from there: half the size first, for it comes sooner
    this.last_ms = performance.now();
    this.tick = this.tick.bind(this);
    this.frame = requestAnimationFrame(this.tick);
  }

  end() {
    cancelAnimationFrame(this.frame);
    this.ended = true;
    this.channel.forget();
  }

  /// 'w', 'a', ... or an arrow's key; false: none of the flight's.
  key(key, isDown, fast) {
    const name = key.length === 1 ? key.toLowerCase() : key;
    if (!['w', 'a', 's', 'd', 'q', 'e', 'ArrowLeft', 'ArrowRight', 'ArrowUp', 'ArrowDown'].includes(name)) return false;
    if (isDown) this.held.add(name);
    else this.held.delete(name);
    this.fast = fast;
    return true;
  }

  look(right, upwards) {
    this.camera.turn(right, upwards);
    this.touched();
  }

  ahead(share) {
    this.camera.move(0, 0, share * this.pace);
    this.touched();
  }

  touched() {
    this.moved_ms = performance.now();
    this.dirty = true;
    this.fulls = 0;
  }

  /// Everything is requested again (labels are newer).
  renew() {
    this.dirty = true;
    this.fulls = 0;
  }

  tick(now_ms) {
    if (this.ended) return;
    this.frame = requestAnimationFrame(this.tick);
    const dt = Math.min(0.1, Math.max(0, (now_ms - this.last_ms) / 1000));
    this.last_ms = now_ms;
    const axis = (plusKey, minusKey) => Number(this.held.has(plusKey)) - Number(this.held.has(minusKey));
    const step = dt * this.pace * (this.fast ? 4 : 1);
    const way = [axis('d', 'a'), axis('e', 'q'), axis('w', 's')];
    const turn = [axis('ArrowRight', 'ArrowLeft'), axis('ArrowUp', 'ArrowDown')];
    if (way.some(Boolean) || turn.some(Boolean)) {
      this.camera.move(...way.map((v) => v * step));
      this.camera.turn(turn[0] * dt * 0.9, turn[1] * dt * 0.9);
      this.touched();
    }
    const still = performance.now() - this.moved_ms >= kStill_ms;
    if (still && this.fulls < 2 && this.channel.idle && !this.dirty) this.ask(true);
    else if (this.dirty && (this.channel.idle || !still)) this.ask(false);
  }

  ask(full) {
    this.dirty = false;
    if (full) this.fulls += 1;
    const asked_ms = performance.now();
    const most_px = full ? Math.round(this.fullSize_px / (3 - this.fulls)) : this.size_px;
    const request = {camera: this.camera.value, most_px, color: true, labels: true, entropy: false, full};
    this.channel.wish(request, (picture) => {
      if (!full && !picture.stale) {
        const took_ms = performance.now() - asked_ms;
        if (took_ms > 450) this.size_px = Math.max(kSizes.least, Math.round(this.size_px * 0.85));
        if (took_ms < 80) this.size_px = Math.min(kSizes.most, Math.round(this.size_px * 1.15));
      }
      if (picture.stale) this.renew();
      else this.changed({...picture, camera: request.camera});
    }, (error) => {
      setTimeout(() => this.renew(), 1000);
      this.trouble(error);
    });
  }
}

// Flying as the page does it: taking off from a view, labelling what is seen, and landing at a photograph that shows it.
import {PictureChannel, Refusal, getJson} from './api.js';
import {byId} from './dom.js';

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

const kMostFlight_px = 640;
const kCamerasAsked = 16;

export class Flights {
  /// Keys held, the camera, and pictures that are small while it moves and full when it stands. page: its state, index, channel, show(view),
  /// whenNamed() and changed(); messages of the page.
  constructor(page, messages, tab) {
    Object.assign(this, {page, messages});
    this.questions = new PictureChannel(`${tab}-at`);  // beside the flight's own pictures
    this.camera = null;      // of a flight
    this.flown = null;       // the picture that is shown
    this.fresh = [];         // clicks that no picture shows yet: {at: fractions, name}
    this.asked = Promise.resolve();  // the questions so far: one after the other, for a newer wish would take the place of a click
    this.waiting = [];       // clicks whose photograph is being looked for
    this.held = new Set();   // keys
    this.tick = this.tick.bind(this);
  }

  get isFlying() { return this.camera !== null; }

  async begin() {
    const {page} = this;
    this.isTakingOff = true;
    try {
      const {views} = page.state;
      const every = Math.max(1, Math.ceil(views.length / kCamerasAsked));
      const others = views.map((_, i) => i).filter((i) => i % every === 0 && i !== page.index);
      const cameras = await Promise.all([page.index, ...others].map((view) => getJson(`./camera?view=${view}`)));
      const canvas = byId('canvas');
      Object.assign(this, {flown: null, fresh: [], revision: page.state.overlay.revision, pace: paceOf(cameras),
                           fullSize_px: Math.min(kMostFlight_px, Math.max(canvas.clientWidth, canvas.clientHeight)),
                           size_px: kSizes.first, last_ms: performance.now(), fast: false, camera: new FreeCamera(cameras[0], upOf(cameras))});
      this.held.clear();
      this.touched();
      this.moved_ms -= kStill_ms;
      this.frame = requestAnimationFrame(this.tick);
    } catch (error) {
      this.messages.refuse(error.message, error.remedy);
    }
    this.isTakingOff = false;
    byId('canvas').focus();
    page.changed();
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
    this.renew();
  }

  /// Everything is requested again.
  renew() {
    this.dirty = true;  // the newest place was not requested
    this.fulls = 0;     // how many of the full pictures were requested from there: half the size first, for it comes sooner
  }

  tick(now_ms) {
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
    if (still && this.fulls < 2 && this.page.channel.idle && !this.dirty) this.wish(true);
    else if (this.dirty && (this.page.channel.idle || !still)) this.wish(false);
  }

  wish(full) {
    this.dirty = false;
    if (full) this.fulls += 1;
    const asked_ms = performance.now();
    const most_px = full ? Math.round(this.fullSize_px / (3 - this.fulls)) : this.size_px;
    const request = {camera: this.camera.value, most_px, color: true, labels: true, entropy: false, full};
    this.page.channel.wish(request, (picture) => {
      if (!full && !picture.stale) {
        const took_ms = performance.now() - asked_ms;
        if (took_ms > 450) this.size_px = Math.max(kSizes.least, Math.round(this.size_px * 0.85));
        if (took_ms < 80) this.size_px = Math.min(kSizes.most, Math.round(this.size_px * 1.15));
      }
      if (picture.stale) this.renew();
      else this.took({...picture, camera: request.camera});
    }, (error) => {
      setTimeout(() => this.renew(), 1000);
      this.messages.wrong(error);
    });
  }

  took(picture) {
    this.flown = {...picture, serial: (this.flown?.serial ?? 0) + 1};
    const isSame = (one, other) => JSON.stringify(one) === JSON.stringify(other);
    this.fresh = this.fresh.filter(({id, camera}) => isSame(camera, picture.camera) && !picture.marks?.some((mark) => mark.id === id));
    this.page.changed();
  }

  end() {
    cancelAnimationFrame(this.frame);
    this.camera = null;
    this.page.channel.forget();
  }

  /// Labels are newer: the picture is requested again.
  follow(revision) {
    if (!this.isFlying || revision === this.revision) return;
    this.revision = revision;
    this.renew();
  }

  /// Marks that the picture shows, with those that came since.
  marks(all) {
    const {flown, fresh} = this;
    if (!flown) return [];
    const known = new Map(all.map((mark) => [mark.id, mark]));
    const seen = (flown.marks ?? []).filter(({id}) => known.has(id)).map(({id, points}) => ({...known.get(id), points}));
    const added = fresh.filter(({id}) => known.has(id)).map(({id, at}) => ({...known.get(id), points: [[at[0] * flown.width, at[1] * flown.height]]}));
    return [...seen, ...added];
  }

  /// What the program knows of a point of a camera's picture: which photograph shows it. Throws Refusal.
  ask(camera, at) {
    const answer = this.asked.then(() => new Promise((resolve, reject) => this.questions.wish({camera, at}, resolve, reject)));
    this.asked = answer.catch(() => {});
    return answer.then((told) => {
      if (told.stale) throw new Refusal('The program was busy.', 'Do it again.', 0);
      return told;
    });
  }

  /// Labels what is seen at a point of a picture, by a click in the photograph that shows it best: also when the person has gone on by then.
  click(at, label, picture) {
    if (!picture?.camera) return this.messages.tell('Wait for the first picture, then click.');
    this.page.whenNamed((named) => this.name({at, label: named, camera: picture.camera, radius: this.page.settings.radius}), label);
  }

  async name(click) {
    const {labeller} = this.page;
    this.waiting.push(click);
    try {
      const {spot, meets_surface: meetsSurface} = await this.ask(click.camera, click.at);
      if (click.isUndone) return;
      if (!spot) return this.refuse(meetsSurface);
      const {id, frame} = labeller.click(spot.view, [spot.at], click.radius, click.label);
      if (this.isFlying) this.fresh.push({id, at: click.at, camera: click.camera});
      this.messages.tell(`Clicked as "${labeller.classOf(click.label.class)?.label ?? click.label.class}" in ${frame}, which shows this place best.`);
    } catch (error) {
      if (!click.isUndone) this.messages.refuse(`The click is not stored: ${error.message}`, error.remedy);
    } finally {
      this.waiting = this.waiting.filter((other) => other !== click);
      this.page.changed();
    }
  }

  /// Takes the last click back whose photograph is still being looked for; false: there is none.
  undo() {
    const last = this.waiting.pop();
    if (last) Object.assign(last, {isUndone: true});
    if (last) this.messages.tell('Undone: the click of the flight.');
    return Boolean(last);
  }

  refuse(meetsSurface) {
    this.messages.refuse(meetsSurface ? 'No training photograph shows this place, so no click can name it' : 'There is no surface here to label',
                         meetsSurface ? 'Click on it from where photographs were taken; v goes to the nearest one' : 'Fly nearer to something; v goes to the nearest photograph');
  }

  /// To the photograph that shows the middle of the picture, or to the one that was taken from about here.
  async toPhotograph() {
    const {camera, flown} = this;
    if (!flown) return this.messages.tell('Wait for the first picture.');
    let answer;
    try {
      answer = await this.ask(flown.camera, [0.5, 0.5]);
    } catch (error) {
      return this.messages.refuse(error.message, error.remedy);
    }
    if (this.camera !== camera) return;  // the person has landed
    const view = answer.spot?.view ?? answer.nearest_view;
    if (!(view >= 0)) return this.messages.tell('No photograph is known yet.');
    this.page.show(view);
    this.messages.tell(answer.spot ? `${this.page.state.views[view].frame} shows what was in the middle.` : `${this.page.state.views[view].frame} is the nearest photograph.`);
  }
}

// Flying as the page does it: taking off from a view, labelling what is seen, and landing at a photograph that shows it.
import {PictureChannel, Refusal, getJson} from './api.js';
import {byId} from './dom.js';
import {FreeCamera, Flight, paceOf, upOf} from './fly.js';

const kMostFlight_px = 640;
const kCamerasAsked = 16;

export class Flights {
  /// page: its state, index, show(view), whenNamed() and changed(); messages of the page.
  constructor(page, messages, tab) {
    Object.assign(this, {page, messages});
    this.questions = new PictureChannel(`${tab}-at`);  // beside the flight's own pictures
    this.flight = null;
    this.flown = null;       // the picture that is shown
    this.fresh = [];         // clicks that no picture shows yet: {at: fractions, name}
    this.asked = Promise.resolve();  // the questions so far: one after the other, for a newer wish would take the place of a click
    this.waiting = [];       // clicks whose photograph is being looked for
  }

  get isFlying() { return this.flight !== null; }

  async begin() {
    const {page} = this;
    this.isTakingOff = true;
    try {
      const {views} = page.state;
      const every = Math.max(1, Math.ceil(views.length / kCamerasAsked));
      const others = views.map((_, i) => i).filter((i) => i % every === 0 && i !== page.index);
      const cameras = await Promise.all([page.index, ...others].map((view) => getJson(`./camera?view=${view}`)));
      const canvas = byId('canvas');
      Object.assign(this, {flown: null, fresh: [], revision: page.state.overlay.revision});
      this.flight = new Flight({
        channel: page.channel,
        camera: new FreeCamera(cameras[0], upOf(cameras)),
        pace: paceOf(cameras),
        fullSize_px: Math.min(kMostFlight_px, Math.max(canvas.clientWidth, canvas.clientHeight)),
        changed: (picture) => this.took(picture),
        trouble: (error) => { if (error.status === 400) this.messages.refuse(error.message, error.remedy); },
      });
    } catch (error) {
      this.messages.refuse(error.message, error.remedy);
    }
    this.isTakingOff = false;
    byId('canvas').focus();
    page.changed();
  }

  took(picture) {
    this.flown = {...picture, serial: (this.flown?.serial ?? 0) + 1};
    const isSame = (one, other) => JSON.stringify(one) === JSON.stringify(other);
    this.fresh = this.fresh.filter(({id, camera}) => isSame(camera, picture.camera) && !picture.marks?.some((mark) => mark.id === id));
    this.page.changed();
  }

  end() {
    this.flight.end();
    this.flight = null;
  }

  /// Labels are newer: the picture is requested again.
  follow(revision) {
    if (!this.flight || revision === this.revision) return;
    this.revision = revision;
    this.flight.renew();
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
      if (this.flight) this.fresh.push({id, at: click.at, camera: click.camera});
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
    const {flight, flown} = this;
    if (!flown) return this.messages.tell('Wait for the first picture.');
    let answer;
    try {
      answer = await this.ask(flown.camera, [0.5, 0.5]);
    } catch (error) {
      return this.messages.refuse(error.message, error.remedy);
    }
    if (this.flight !== flight) return;  // the person has landed
    const view = answer.spot?.view ?? answer.nearest_view;
    if (!(view >= 0)) return this.messages.tell('No photograph is known yet.');
    this.page.show(view);
    this.messages.tell(answer.spot ? `${this.page.state.views[view].frame} shows what was in the middle.` : `${this.page.state.views[view].frame} is the nearest photograph.`);
  }
}

// Flying as the page does it: taking off from a view, labelling what is seen, and landing at a photograph that shows it.
import {PictureChannel, getJson} from './api.js';
import {byId} from './dom.js';
import {FreeCamera, Flight, paceOf, upOf} from './fly.js';

const kMostFlight_px = 640;
const kCamerasAsked = 16;

export class Flights {
  /// page: its state, index, show(view), hasClass() and changed(); messages of the page.
  constructor(page, messages, tab) {
    Object.assign(this, {page, messages});
    this.questions = new PictureChannel(`${tab}-at`);  // beside the flight's own pictures
    this.flight = null;
    this.flown = null;       // the picture that is shown
    this.fresh = [];         // clicks that no picture shows yet: {at: fractions, name}
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
    this.questions.forget();
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

  /// What the program knows of a point of the picture that is shown: which photograph shows it.
  ask(at) {
    const {camera} = this.flown;
    return new Promise((resolve) => {
      this.questions.wish({camera, at}, (answer) => resolve({...answer, camera}), (error) => {
        this.messages.refuse(error.message, error.remedy);
        resolve(null);
      });
    });
  }

  /// Labels what is seen at a point, by a click in the photograph that shows it best.
  async click(at) {
    if (!this.flown) return this.messages.tell('Wait for the first picture, then click.');
    if (!(await this.page.hasClass())) return;
    const answer = await this.ask(at);
    if (!answer || !this.flight) return;
    if (!answer.spot) return this.refuse(answer.meets_surface);
    const {labeller, settings, state} = this.page;
    const {view, at: pixel} = answer.spot;
    labeller.click(view, [pixel], settings.radius);
    this.fresh.push({id: labeller.marks.at(-1).id, at, camera: answer.camera});
    this.messages.tell(`Clicked as "${labeller.classOf(labeller.chosen).label ?? labeller.chosen}" in ${state.views[view].frame}, which shows this place best.`);
    this.page.changed();
  }

  refuse(meetsSurface) {
    this.messages.refuse(meetsSurface ? 'No training photograph shows this place, so no click can name it' : 'There is no surface here to label',
                         meetsSurface ? 'Click on it from where photographs were taken; v goes to the nearest one' : 'Fly nearer to something; v goes to the nearest photograph');
  }

  /// To the photograph that shows the middle of the picture, or to the one that was taken from about here.
  async toPhotograph() {
    if (!this.flown) return this.messages.tell('Wait for the first picture.');
    const answer = await this.ask([0.5, 0.5]);
    if (!answer || !this.flight) return;
    const view = answer.spot?.view ?? answer.nearest_view;
    if (!(view >= 0)) return this.messages.tell('No photograph is known yet.');
    this.page.show(view);
    this.messages.tell(answer.spot ? `${this.page.state.views[view].frame} shows what was in the middle.` : `${this.page.state.views[view].frame} is the nearest photograph.`);
  }
}

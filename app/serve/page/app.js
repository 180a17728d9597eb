// The page put together: state comes in, the parts show it, keys and buttons act.
import {actionsOf} from './actions.js';
import {PictureChannel, followState, getJson, postJson} from './api.js';
import {cssColor} from './colors.js';
import {askClass, showHelp} from './dialogs.js';
import {byId, make, setAttribute, setText} from './dom.js';
import {safeStorage} from './events.js';
import {FreeCamera, Flight, paceOf, upOf} from './fly.js';
import {followKeys} from './keys.js';
import {Labeller} from './labeller.js';
import {OverlayEvents, reason} from './model.js';
import {Messages, Panel} from './panel.js';
import {Pictures} from './pictures.js';
import {Settings} from './settings.js';
import {Stage} from './stage.js';
import {Strip} from './strip.js';

const kRenderPause_ms = 4000;     // between renderings of a view that is only looked at
const kMostFlight_px = 640;
const kCamerasAsked = 16;
const kLost = 'Connection lost, trying again; nothing is lost.';
const kMoved = 'Another run or a new start answers here: open the address that the program prints; nothing is lost.';

class Page {
  constructor() {
    this.changed = this.changed.bind(this);
    this.redraw = this.redraw.bind(this);
    this.settings = new Settings();
    this.session = safeStorage('sessionStorage');
    this.messages = new Messages();
    const refuse = (...told) => this.messages.refuse(...told);
    this.labeller = new Labeller({changed: this.changed, tell: (text) => this.messages.tell(text), refuse});
    this.channel = new PictureChannel(this.labeller.ids.tab);
    this.pictures = new Pictures(this.channel, this.changed, (error) => { if (error.status === 400) refuse(error.message, error.remedy); });
    this.overlayEvents = new OverlayEvents();
    this.index = 0;
    this.isRendered = false;
    this.flight = null;
    this.strip = new Strip((view) => this.show(view));
    this.panel = new Panel({
      choose: (name) => this.choose(name),
      rename: (row) => this.change(row),
      point: (name) => { this.stage.pointed = name; this.redraw(); },
      export: (what) => postJson('./export', {what}).catch((error) => refuse(error.message, error.remedy)),
      cancelExport: (id) => postJson('./export', {cancel: id}).catch((error) => refuse(error.message, error.remedy)),
    });
    this.stage = new Stage(this.labeller, this.settings, {
      changed: this.redraw,
      click: (points) => this.click(points),
      isFlying: () => this.flight !== null,
      drag: (dx, dy) => this.flight.look(dx * 0.004, -dy * 0.004),
      wheel: (factor) => this.flight.ahead(Math.log(factor) * 1.5),
    });
    this.connect();
    followState({state: (value, anew) => this.take(value, anew), lost: (error) => this.lose(error)});
  }

  get state() { return this.labeller.state; }
  get classes() { return this.labeller.classes; }

  take(value, anew) {
    const isFirst = this.state === null;
    this.isLost = null;
    if (anew && !isFirst) this.pictures.forget();
    this.overlayEvents.tell(value.overlay);
    this.labeller.take(value, anew);
    if (isFirst) this.show(Number(this.session.getItem('semfield.view') ?? this.state.proposal?.view ?? 0));
    this.labeller.chosen ??= this.classes.length === 1 ? this.classes[0].name : null;
    if (this.state.failure && this.failure !== this.state.failure) {
      this.messages.refuse(`Training has ended: ${this.state.failure}`, 'The labels are safe; start the program again to go on.');
    }
    this.failure = this.state.failure;
    this.messages.hold('trouble', this.state.trouble ? `Not written: ${this.state.trouble}` : '', 'Labelling and training go on, and it is tried again.');
    this.changed();
  }

  lose(error) {
    this.isLost = error.status === 403 || error.status === 404 ? kMoved : kLost;
    this.changed();
  }

  /// Something shown is another: drawn once, before the next frame.
  changed() {
    this.isStale = true;
    this.redraw();
  }

  /// The view alone is another: the pointer moved.
  redraw() {
    if (this.isScheduled) return;
    this.isScheduled = true;
    requestAnimationFrame(() => {
      this.isScheduled = false;
      if (this.isStale) this.update();
      else if (this.state) this.draw();
    });
  }

  update() {
    this.isStale = false;
    this.updateFoot();
    if (!this.state) return;
    const {views} = this.state;
    this.index = Math.min(this.index, Math.max(0, views.length - 1));
    document.title = `${this.state.run.name} - Semfield`;
    const clicks = views.map(() => 0);
    for (const {view} of this.labeller.marks) clicks[view] += 1;
    this.strip.update(views, clicks, this.index, this.labeller.proposal?.view ?? -1);
    this.panel.updateClasses(this.classes, this.labeller.chosen, this.settings.keysOf(this.classes), this.state.room);
    this.panel.updateRun(this.state);
    this.updateTools();
    this.updateProposal();
    this.updateWelcome();
    this.draw();
  }

  updateFoot() {
    const {unsaved} = this.labeller;
    setText(byId('connection'), this.isLost ?? (this.state ? 'connected' : 'connecting'));
    byId('connection').classList.toggle('lost', Boolean(this.isLost));
    setText(byId('saving'), unsaved ? `${unsaved} not saved yet` : this.labeller.marks.length ? 'every click is saved' : '');
    byId('saving').classList.toggle('waiting', unsaved > 0);
    if (!unsaved) this.messages.settled();
  }

  updateTools() {
    const {stage, settings} = this;
    for (const [id, on] of [['show-photo', !this.isRendered], ['show-rendered', this.isRendered], ['show-labels', stage.kind === 'labels'],
                            ['show-entropy', stage.kind === 'entropy'], ['fly', this.flight !== null]]) {
      setAttribute(byId(id), 'aria-pressed', on);
    }
    byId('opacity').value = stage.isHidden ? 0 : settings.opacity;
    setText(byId('opacity-value'), stage.isHidden ? 'off' : `${settings.opacity} %`);
    byId('radius').value = settings.radius;
    setText(byId('radius-value'), `${settings.radius} px`);
    byId('legend').hidden = stage.kind !== 'entropy' || this.flight !== null;
    byId('pad').hidden = !this.flight;
    byId('canvas').classList.toggle('flying', this.flight !== null);
    const view = this.state.views[this.index];
    setAttribute(byId('canvas'), 'aria-label', this.flight ? 'Free camera' : view ? `View ${view.frame}` : 'No view');
  }

  updateProposal() {
    const {proposal, chosen} = this.labeller;
    const text = byId('proposal-text');
    const isHere = proposal?.view === this.index && !this.flight;
    const none = this.classes.length === 0;
    const guess = this.classes.find(({index}) => index >= 0 && index === proposal?.class_guess);
    text.classList.toggle('some', Boolean(proposal) && !this.flight);
    setText(text, this.flight ? 'Flying: w a s d q e move, drag looks around, f leaves.'
      : !proposal ? 'No click is proposed at the moment.'
      : `Click proposed ${isHere ? 'here' : `in ${this.state.views[proposal.view].frame}`}: ${reason(proposal.why)}.`);
    const take = byId('proposal-take');
    take.hidden = byId('proposal-skip').hidden = !proposal || this.flight !== null;
    this.fill(take, !isHere ? ['Go to it'] : chosen !== null ? ['Label as ', this.classOf(chosen)] : [none ? 'Name it' : 'Choose a class'], isHere && chosen === null && !none ? '' : 'space');
    take.disabled = isHere && chosen === null && !none;
    const button = byId('proposal-guess');
    button.hidden = take.hidden || !isHere || !guess || guess.name === chosen;
    if (!button.hidden) this.fill(button, ['Guess: ', guess], 'g');
  }

  classOf(name) { return this.labeller.classOf(name); }

  /// A button's words, a class with its swatch among them, and its key.
  fill(button, parts, key) {
    const told = JSON.stringify([parts, key]);
    if (button.told === told) return;
    button.told = told;
    button.replaceChildren(...parts.flatMap((part) => {
      if (typeof part === 'string') return [part];
      const dot = make('span', {class: 'dot'});
      dot.style.setProperty('--color', cssColor(part.color));
      return [dot, part.name];
    }), ...(key ? [' ', make('kbd', {}, key)] : []));
  }

  updateWelcome() {
    const welcome = byId('welcome');
    const {views} = this.state;
    const hasMarks = this.labeller.marks.length > 0;
    const words = views.length === 0 ? ['There is no view to label', 'The scene has no training frame.']
      : this.classes.length === 0 ? ['Name the first class', 'Press n, or click on something in the picture. Colour and geometry are being learned already; ' +
          'labels of all views follow within a second of the first clicks.']
      : !hasMarks && this.labeller.chosen === null ? ['Choose a class, then click', 'Keys 1 to 9 choose a class, n makes one. A click, or a drag along something, labels it.']
      : !hasMarks ? [`Click on something that is "${this.labeller.chosen}"`, 'Or drag along it. Keys 1 to 9 choose another class, n makes one.'] : null;
    welcome.hidden = !words || this.flight !== null;
    if (words && this.welcomed !== words[0]) welcome.replaceChildren(make('h2', {}, words[0]), make('p', {}, words[1]));
    this.welcomed = words?.[0];
  }

  draw() {
    if (this.flight) return this.stage.drawFlight(this.flown, this.flown ? `${this.flown.width} x ${this.flown.height}, ${Math.round(this.flown.render_ms)} ms` : 'Taking off');
    const view = this.state.views[this.index];
    if (!view) return;
    const overlay = this.pictures.overlay(this.index);
    if (!document.hidden && (view.ready || this.isRendered)) {
      this.pictures.want({view: this.index, entropy: this.stage.kind === 'entropy', color: this.isRendered}, this.state.overlay.revision, kRenderPause_ms);
    }
    const events = overlay ? this.overlayEvents.known(overlay.revision) : -1;
    const {proposal} = this.labeller;
    this.stage.drawView({
      index: this.index,
      picture: (this.isRendered ? overlay?.color : null) ?? this.pictures.photo(this.index, view.photo),
      overlay,
      marks: this.labeller.marks.filter((mark) => mark.view === this.index),
      isPainted: ({id, saved}) => saved && this.labeller.births.isPainted(id, events),
      ring: proposal?.view === this.index ? proposal.at : null,
    });
  }

  show(view) {
    if (!this.state || !(view >= 0 && view < this.state.views.length)) return;
    this.land();
    this.index = view;
    this.stage.cross = null;
    this.session.setItem('semfield.view', view);
    this.stage.fit();
    this.changed();
  }

  choose(name) {
    if (name !== undefined && name !== null) this.labeller.choose(name);
  }

  async make() {
    if (!this.state) return false;
    if (this.classes.length >= this.state.room.most) {
      this.messages.refuse(`No name is free: this run has room for ${this.state.room.named} classes.`, 'Rename one that is not needed (F2).');
      return false;
    }
    const answer = await askClass(this.classes);
    byId('canvas').focus();
    if (answer) this.labeller.addClass(answer.name, answer.color);
    return answer !== null;
  }

  async change(row) {
    if (!row) return this.messages.tell('Choose the class to change first.');
    const answer = await askClass(this.classes, row);
    if (answer && (answer.name !== row.name || answer.color.join() !== row.color.join())) this.labeller.changeClass(row.name, answer.name, answer.color);
  }

  /// True when a class is chosen, if need be after a dialog.
  async hasClass() {
    if (this.labeller.chosen !== null) return true;
    if (this.classes.length === 0) return this.make();
    this.messages.tell('Choose a class first: keys 1 to 9, or n for a new one.');
    return false;
  }

  async click(points) {
    const {index} = this;
    if (this.state && await this.hasClass()) this.labeller.click(index, points, this.settings.radius);
  }

  async space() {
    const {proposal} = this.labeller;
    if (!proposal) return this.messages.tell('No click is proposed at the moment.');
    if (proposal.view !== this.index || this.flight) return this.show(proposal.view);
    if (!this.stage.isInSight(proposal.at)) return this.stage.fit();
    if (await this.hasClass() && this.labeller.proposal?.id === proposal.id) this.labeller.takeProposal(this.settings.radius);
  }

  takeGuess() {
    const {proposal} = this.labeller;
    const guess = proposal && this.classes.find(({index}) => index >= 0 && index === proposal.class_guess);
    if (!guess) return this.messages.tell('There is no guess.');
    if (proposal.view !== this.index) return this.show(proposal.view);
    this.choose(guess.name);
    this.labeller.takeProposal(this.settings.radius);
  }

  skip() {
    if (this.labeller.proposal) this.labeller.skipProposal();
    else this.messages.tell('No click is proposed at the moment.');
  }

  setKind(kind) {
    this.stage.kind = kind;
    this.stage.isHidden = false;
    this.changed();
  }

  setRendered(on) {
    this.isRendered = on;
    this.changed();
  }

  setOpacity(opacity) {
    this.stage.isHidden = false;
    this.settings.set({opacity});
    this.changed();
  }

  setRadius(radius) {
    this.settings.set({radius: Math.min(Math.max(radius, 0), 40)});
    this.changed();
  }

  neighbourClass(step) {
    const at = this.classes.findIndex(({name}) => name === this.labeller.chosen);
    if (this.classes.length) this.choose(this.classes[(at + step + this.classes.length) % this.classes.length].name);
  }

  async fly() {
    if (this.flight || this.isTakingOff || !this.state) return this.land();
    this.isTakingOff = true;
    try {
      const every = Math.max(1, Math.ceil(this.state.views.length / kCamerasAsked));
      const others = this.state.views.map((_, i) => i).filter((i) => i % every === 0 && i !== this.index);
      const cameras = await Promise.all([this.index, ...others].map((view) => getJson(`./camera?view=${view}`)));
      this.flown = null;
      const canvas = byId('canvas');
      this.flight = new Flight({
        channel: this.channel,
        camera: new FreeCamera(cameras[0], upOf(cameras)),
        pace: paceOf(cameras),
        fullSize_px: Math.min(kMostFlight_px, Math.max(canvas.clientWidth, canvas.clientHeight)),
        changed: (picture) => {
          this.flown = {...picture, serial: (this.flown?.serial ?? 0) + 1};
          this.changed();
        },
        trouble: (error) => { if (error.status === 400) this.messages.refuse(error.message, error.remedy); },
      });
    } catch (error) {
      this.messages.refuse(error.message, error.remedy);
    }
    this.isTakingOff = false;
    byId('canvas').focus();
    this.changed();
  }

  land() {
    if (!this.flight) return;
    this.flight.end();
    this.flight = null;
    this.pictures.wished = null;
    this.stage.fit();
    this.changed();
  }

  connect() {
    const {stage, labeller} = this;
    const on = (id, act) => byId(id).addEventListener('click', act);
    on('show-photo', () => this.setRendered(false));
    on('show-rendered', () => this.setRendered(true));
    on('show-labels', () => this.setKind('labels'));
    on('show-entropy', () => this.setKind('entropy'));
    on('undo', () => labeller.undo());
    on('redo', () => labeller.redo());
    on('fit', () => stage.fit());
    on('fly', () => this.fly());
    on('land', () => this.land());
    on('help', showHelp);
    on('new-class', () => this.make());
    on('proposal-take', () => this.space());
    on('proposal-guess', () => this.takeGuess());
    on('proposal-skip', () => this.skip());
    byId('opacity').addEventListener('input', () => this.setOpacity(Number(byId('opacity').value)));
    byId('radius').addEventListener('input', () => this.setRadius(Number(byId('radius').value)));
    for (const button of document.querySelectorAll('#pad [data-key]')) {
      button.addEventListener('pointerdown', () => this.flight?.key(button.dataset.key, true, false));
      for (const end of ['pointerup', 'pointerleave', 'pointercancel']) button.addEventListener(end, () => this.flight?.key(button.dataset.key, false, false));
    }
    addEventListener('blur', () => this.flight?.held.clear());
    document.addEventListener('visibilitychange', this.changed);

    followKeys(actionsOf(this), (event, isDown) => Boolean(this.flight?.key(event.key, isDown, event.shiftKey)));
  }
}

new Page();

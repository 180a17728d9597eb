// The page put together: state comes in, the parts show it, keys and buttons act.
import {followState} from './api.js';
import {Settings, actionsOf, ask, askClass, followClicksBeside, followKeys} from './dialogs.js';
import {byId, safeStorage} from './dom.js';
import {Labeller} from './labeller.js';
import {OverlayEvents} from './model.js';
import {Bars, Messages, Panel, Strip} from './panel.js';
import {Pictures} from './pictures.js';
import {Stage} from './stage.js';

const kRenderPause_ms = 4000;     // between renderings of a view that is only looked at
const kLost = 'Connection lost, trying again; nothing is lost.';
const kMoved = 'Another run or a new start answers here: open the address that the program prints; nothing is lost.';

class Page {
  constructor() {
    this.changed = this.changed.bind(this);
    this.redraw = this.redraw.bind(this);
    this.settings = new Settings();
    this.session = safeStorage('sessionStorage');
    this.messages = new Messages();
    this.labeller = new Labeller(this);
    this.pictures = new Pictures(this, this.labeller.ids.tab);
    this.overlayEvents = new OverlayEvents();
    this.index = 0;
    this.isRendered = false;
    this.bars = new Bars(this, this.messages);
    this.strip = new Strip(this);
    this.panel = new Panel(this);
    this.stage = new Stage(this);
    this.connect();
    followState({state: (value, anew) => this.take(value, anew), lost: (error) => this.lose(error)});
  }

  get state() { return this.labeller.state; }
  get classes() { return this.labeller.classes; }
  get view() { return this.state.views[this.index]; }

  take(value, anew) {
    const isFirst = this.state === null;
    this.isLost = null;
    if (anew && !isFirst) this.pictures.forget();
    this.overlayEvents.tell(value.overlay);
    this.labeller.take(value, anew);
    if (isFirst) this.show(Number(this.session.getItem('semfield.view') ?? this.state.proposal?.view ?? 0));
    this.labeller.chosen ??= this.classes.length === 1 ? this.classes[0].name : null;
    if (this.state.failure && this.failure !== this.state.failure) {
      this.messages.refuse(`Training has ended: ${this.state.failure}`, 'The labels are safe; start the program again to continue.');
    }
    this.failure = this.state.failure;
    this.messages.hold('trouble', this.state.trouble ? `Not written: ${this.state.trouble}` : '', 'Labelling and training continue, and it is tried again.');
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
    this.bars.foot();
    if (!this.state) return;
    const {views} = this.state;
    this.index = Math.min(this.index, Math.max(0, views.length - 1));
    document.title = `${this.state.run.name} - Semfield`;
    const clicks = views.map(() => 0);
    for (const {view} of this.labeller.marks) clicks[view] += 1;
    this.strip.update(views, clicks, this.index, this.labeller.proposal?.view ?? -1);
    this.panel.updateClasses(this.classes, this.labeller.ignore, this.labeller.chosen, this.settings.keysOf(this.classes), this.state.room);
    this.panel.updateRun(this.state);
    this.bars.update();
    this.offered = this.labeller.proposal?.id;
    this.draw();
  }

  select(mark) { this.set(this.stage, {selected: mark?.id ?? null}); }

  /// The mark that is selected or pointed at goes.
  remove() {
    const mark = this.stage.meant;
    if (!mark) return this.messages.tell('Point at a click, or select it with a click of its own class; then Delete removes it.');
    this.stage.selected = null;
    this.labeller.erase([mark]);
  }

  classOf(name) { return this.labeller.classOf(name); }

  draw() {
    const {view, labeller} = this;
    if (!view) return;
    const overlay = this.pictures.overlay(this.index);
    if (!document.hidden && (view.ready || this.isRendered)) {
      this.pictures.want({view: this.index, entropy: this.stage.kind === 'entropy', color: this.isRendered}, this.state.overlay.revision, kRenderPause_ms);
    }
    const events = overlay ? this.overlayEvents.known(overlay.revision) : -1;
    const {proposal} = labeller;
    this.stage.view.setImage(view.width, view.height);
    const {port, ratio} = this.stage.view;
    const view_px = Math.max(view.width, view.height);
    const photo = this.isRendered && overlay?.color ? null : this.pictures.photo(this.index, view.photo, view_px, view_px * port.scale * (ratio ?? 1));
    const known = new Map(labeller.marks.map((mark) => [mark.id, mark]));
    const share = view.width / (overlay?.width ?? view.width);
    this.stage.drawView({
      index: this.index,
      isLocked: view.held_out,
      picture: photo ?? overlay?.color,
      overlay,
      marks: labeller.marks.filter((mark) => mark.view === this.index),
      others: (overlay?.marks ?? []).filter(({id}) => known.has(id) && known.get(id).view !== this.index).map(({id, points}) => ({
        ...known.get(id), points: points.map((p) => p.map((v) => v * share)), frame: this.state.views[known.get(id).view].frame})),
      isPainted: ({id, saved}) => saved && this.labeller.births.isPainted(id, events),
      ring: proposal?.view === this.index ? proposal.at : null,
    });
  }

  show(view) {
    if (!this.state || !(view >= 0 && view < this.state.views.length)) return;
    this.index = view;
    Object.assign(this.stage, {cross: null, selected: null, marks: [], others: []});
    this.stage.tools.drop();
    this.session.setItem('semfield.view', view);
    this.stage.fit();
    this.changed();
  }

  choose(name) {
    if (name !== undefined && name !== null) this.labeller.choose(name);
  }

  chooseByKey(digit) {
    const name = [...this.settings.keysOf(this.classes)].find(([, key]) => key === digit)?.[0];
    if (name === undefined) return this.messages.tell(`No class has the key ${digit}; shift and ${digit} gives it to the chosen one.`);
    this.choose(name);
  }

  chooseSeen() {
    const name = this.stage.aim && this.stage.classAt(this.stage.aim);
    if (name) this.choose(name);
    else this.messages.tell('There is no label under the pointer.');
  }

  /// To another view of the strip.
  step(steps) {
    const to = this.strip.neighbour(this.index, steps);
    if (to === this.index) return this.messages.tell(steps < 0 ? 'This is the first view.' : 'This is the last view.');
    this.show(to);
  }

  /// then(): what waits for the class, done with it.
  make(then) {
    if (!this.state) return this.messages.tell('Wait until the program is connected.');
    if (this.classes.length >= this.state.room.most) {
      return this.messages.refuse(`No name is free: this run has room for ${this.state.room.named} classes.`, 'Rename one that is not needed (F2).');
    }
    askClass(this.classes, null, (answer) => {
      byId('canvas').focus();
      if (answer) this.labeller.addClass(answer.name, answer.color);
      if (answer) then?.();
      else if (then) this.messages.tell('Not stored: the click has no class.');
    });
  }

  change(row) {
    if (!row) return this.messages.tell('Choose the class to change first.');
    if (row.isIgnore) return this.messages.tell('What is ignored has no name of its own.');
    askClass(this.classes, row, (answer) => {
      if (answer?.mergeInto) return this.labeller.mergeClass(row.name, answer.mergeInto);
      if (answer?.isDeleted) return this.deleteClass(row);
      if (answer && (answer.name !== row.name || answer.color.join() !== row.color.join())) this.labeller.changeClass(row.name, answer.name, answer.color);
    });
  }

  deleteClass({name, clicks}) {
    const what = clicks ? `Its ${clicks} click${clicks === 1 ? '' : 's'} go with it, in all views.` : 'It has no clicks.';
    ask(`Delete "${name}"?`, `${what} Undo (z) brings it back.`, 'Delete it', (isMeant) => {
      if (isMeant) this.labeller.deleteClass(name);
      else this.messages.tell(`"${name}" stays.`);
    });
  }

  enter() {
    const {stage} = this;
    if (stage.tools.close()) return;
    if (!stage.cross) return this.messages.tell('Move a cross over the view with shift and the arrow keys; enter clicks there.');
    if (stage.tools.kind === 'polygon') stage.tools.clickCorner(stage.cross);
    else stage.tools.click({points: [stage.cross], radius: this.settings.radius, view: this.index});
  }

  /// Out of what is under way: a polygon, a selection.
  leave() {
    this.stage.tools.drop();
    this.select(null);
  }

  /// The proposal that the person sees, or null: then it says why, or goes there.
  seenProposal(isToBeSeen = true) {
    const {proposal} = this.labeller;
    if (!proposal) return this.messages.tell('No click is proposed at the moment.');
    if (proposal.id !== this.offered) return this.messages.tell('Not stored: another click has just been proposed. Look at it first.');
    if (!isToBeSeen) return proposal;
    if (proposal.view !== this.index) return this.show(proposal.view);
    return this.stage.isInSight(proposal.at) ? proposal : this.stage.fit();
  }

  space() {
    const proposal = this.seenProposal();
    if (proposal) this.stage.tools.whenNamed((label) => this.labeller.takeProposal(proposal, this.settings.radius, label));
  }

  takeGuess() {
    const guess = this.labeller.proposal && this.classes.find(({index}) => index >= 0 && index === this.labeller.proposal.class_guess);
    if (!guess) return this.messages.tell('There is no guess.');
    const proposal = this.seenProposal();
    if (!proposal) return;
    this.choose(guess.name);
    this.labeller.takeProposal(proposal, this.settings.radius);
  }

  skip() {
    const proposal = this.seenProposal(false);
    if (proposal) this.labeller.skipProposal(proposal);
  }

  /// What is shown is another: values of the page or its stage.
  set(part, values) {
    Object.assign(part, values);
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

  connect() {
    const {stage} = this;
    const actions = actionsOf(this);
    for (const button of document.querySelectorAll('[data-act]')) button.addEventListener('click', () => actions[button.dataset.act]());
    const on = (id, act) => byId(id).addEventListener('click', act);
    on('show-photo', () => this.set(this, {isRendered: false}));
    on('show-rendered', () => this.set(this, {isRendered: true}));
    for (const kind of ['labels', 'entropy']) on(`show-${kind}`, () => this.set(stage, {kind, isHidden: false}));
    on('selection-close', () => this.select(null));
    byId('opacity').addEventListener('input', () => {
      this.settings.set({opacity: Number(byId('opacity').value)});
      this.set(stage, {isHidden: false});
    });
    byId('radius').addEventListener('input', () => this.setRadius(Number(byId('radius').value)));
    document.addEventListener('visibilitychange', this.changed);

    followClicksBeside(() => this.messages.tell('Not stored: a window is open over the picture. Answer it first.'));
    followKeys(actions);
  }
}

new Page();

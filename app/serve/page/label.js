// The labelling page put together: state comes in, the parts show it, keys and buttons act.
import {PictureCamera} from './camera.js';
import {Settings, ask, askClass, followClicksBeside, kFingers, keyTable} from './dialogs.js';
import {byHand, byId, onClick, safeStorage} from './dom.js';
import {Labeller} from './labeller.js';
import {Page} from './page.js';
import {Bars, Panel, Strip} from './panel.js';
import {Pictures} from './pictures.js';
import {Stage} from './stage.js';

class LabelPage extends Page {
  constructor() {
    super(new PictureCamera());
    this.settings = new Settings();
    this.session = safeStorage('sessionStorage');
    this.labeller = new Labeller(this);
    this.pictures = new Pictures(this, this.labeller.ids.tab);
    this.index = 0;
    this.isRendered = false;
    this.bars = new Bars(this);
    this.strip = new Strip(this);
    this.panel = new Panel(this);
    this.stage = new Stage(this);
    this.resize();
    this.connect();
    this.followProgram();
  }

  get state() { return this.labeller.state; }
  get classes() { return this.labeller.classes; }
  get view() { return this.state?.views[this.index]; }

  take(value, anew) {
    const isFirst = this.state === null;
    if (anew && !isFirst) this.pictures.forget();
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
    this.panel.updateClasses(this.classes, this.labeller.ignore, this.labeller.chosen, this.settings.keysOf(this.classes), this.state);
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

  draw() { if (this.view) this.stage.draw(); }

  show(view) {
    if (!this.state || !(view >= 0 && view < this.state.views.length)) return;
    this.index = view;
    Object.assign(this.stage, {cross: null, selected: null, marks: [], others: []});
    this.stage.tools.drop();
    this.session.setItem('semfield.view', view);
    this.camera.fit();
    this.changed();
  }

  choose(name) { this.labeller.choose(name); }

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
    const what = clicks === 1 ? 'Its click goes with it.' : clicks ? `Its ${clicks} clicks go with it, in all views.` : 'It has no clicks.';
    ask(`Delete "${name}"?`, `${what} Undo${byHand(' (z)', '')} brings it back.`, 'Delete it', (isMeant) => {
      if (isMeant) this.labeller.deleteClass(name);
      else this.messages.tell(`"${name}" stays.`);
    });
  }

  enter() {
    const {stage} = this;
    if (stage.tools.close() || (stage.tools.thing.isHeld && stage.tools.thing.accept())) return;
    if (!stage.cross) return this.messages.tell('Move a cross over the view with shift and the arrow keys; enter clicks there.');
    if (stage.tools.kind === 'thing') stage.tools.thing.up(stage.cross, true);
    else if (stage.tools.kind === 'polygon') stage.tools.clickCorner(stage.cross);
    else stage.tools.click({points: [stage.cross], radius: this.settings.radius, view: this.index});
  }

  /// The proposal that the person sees, or null: then it says why, or goes there.
  seenProposal(isToBeSeen = true) {
    const {proposal} = this.labeller;
    if (!proposal) return this.messages.tell('No click is proposed at the moment.');
    if (proposal.id !== this.offered) return this.messages.tell('Not stored: another click has just been proposed. Look at it first.');
    if (!isToBeSeen) return proposal;
    if (proposal.view !== this.index) return this.show(proposal.view);
    return this.stage.isInSight(proposal.at) ? proposal : this.look('fit');
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
    this.followKeys(keyTable(this), kFingers);
    onClick('show-photo', () => this.set(this, {isRendered: false}));
    onClick('show-rendered', () => this.set(this, {isRendered: true}));
    for (const kind of ['labels', 'entropy']) onClick(`show-${kind}`, () => this.set(stage, {kind, isHidden: false}));
    onClick('selection-close', () => this.select(null));
    byId('opacity').addEventListener('input', () => {
      this.settings.set({opacity: Number(byId('opacity').value)});
      this.set(stage, {isHidden: false});
    });
    byId('radius').addEventListener('input', () => this.setRadius(Number(byId('radius').value)));
    document.addEventListener('visibilitychange', this.changed);

    followClicksBeside(() => this.messages.tell('Not stored: a window is open over the picture. Answer it first.'));
  }
}

new LabelPage();

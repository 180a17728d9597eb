// What a person does to the labels: clicks, classes, undo. Keeps what the program does not know yet and adds it to its state.
import {byHand, safeStorage, store, stored} from './dom.js';
import {EventQueue, Ids} from './api.js';
import {MarkBirths, combined, kIgnore, merged, outlineCorners, strokeParts} from './model.js';

const kMostHistory = 300;

export const shapeOf = ({points, fill}) => (fill ? 'polygon' : points.length > 1 ? 'stroke' : 'click');

export class Labeller {
  constructor({changed, messages}) {
    Object.assign(this, {changed, messages});
    this.ids = new Ids();
    this.storage = safeStorage('sessionStorage');
    this.state = null;
    this.classes = [];
    this.marks = [];
    this.ignore = {...kIgnore, name: 'void', clicks: 0};  // the row of what is ignored
    this.births = new MarkBirths();
    this.pending = [];      // [{event, revision}]; revision: of the response, null before it came
    this.everyEvent = new Map();
    this.undoable = [];     // own events, the last one last
    this.redoable = [];     // undo events
    this.chosen = null;     // name of the class of the next click
    this.object = 0;        // number of the thing that the next click is on; 0: what touches is one thing
    this.skipped = null;    // id of the proposal that was taken or skipped here
    this.queue = new EventQueue({
      tab: this.ids.tab,
      changed: () => this.changed(),
      acknowledged: (event, answer) => {
        const item = this.pending.find((entry) => entry.event.id === event.id);
        if (item) item.revision = answer.revision;
        this.settle();
      },
      refused: (event, error) => {
        this.forget(event);
        this.messages.refuse(`Not taken (${this.inWords(event)}): ${error.message}`, error.remedy);
      },
      failed: (error) => {
        if (error.status >= 500) this.messages.refuse(error.message, error.remedy || 'It stays in this browser and is sent again.', true);
      },
    });
  }

  /// What an event did, for a message.
  inWords(event) {
    const name = event.class === this.ignore.name ? 'ignore' : `"${event.class}"`;
    switch (event.type) {
      case 'click': return `${shapeOf(event)} ${name} in ${event.frame}`;
      case 'class': return `class "${event.name}"`;
      case 'rename': return event.class === event.name ? `colour of "${event.name}"` : `"${event.class}" is "${event.name}"`;
      case 'merge': return `${name} merged into "${event.into}"`;
      case 'delete': return `class ${name} deleted`;
      case 'undo': return this.everyEvent.has(event.of) ? `deletion of ${this.inWords(this.everyEvent.get(event.of))}` : 'deletion';
      default: return 'skipped proposal';
    }
  }

  get unsaved() { return this.queue.unsent.length; }

  /// A state that the program sent; anew: it may be another process.
  take(answer, anew) {
    const first = this.state === null;
    this.state = merged(anew ? null : this.state, answer);
    this.births.see(this.state, anew);
    if (first) {
      this.remembered();
      this.queue.open(this.state.run.id);
      for (const event of this.queue.unsent) {
        this.everyEvent.set(event.id, event);
        this.pending.push({event, revision: null});
      }
    }
    if (anew) {
      // What was acknowledged is in the file, so this process knows it.
      for (const item of this.pending) if (item.revision !== null) item.revision = 0;
      this.queue.poke();
    }
    if (this.skipped && this.state.proposal?.id !== this.skipped) this.skipped = null;
    this.settle();
  }

  settle() {
    if (!this.state) return;
    this.pending = this.pending.filter((item) => item.revision === null || item.revision > this.state.revision);
    const index = this.classes.find((row) => row.name === this.chosen)?.index ?? -1;
    Object.assign(this, combined(this.state, this.pending, this.everyEvent));
    if (this.chosen !== null && !this.classOf(this.chosen)) {
      this.chosen = this.classes.find((row) => row.index === index && index >= 0)?.name ?? null;
    }
    this.changed();
  }

  /// The proposal, unless it was answered here already.
  get proposal() {
    const {proposal} = this.state ?? {};
    return proposal && proposal.id !== this.skipped ? proposal : null;
  }

  /// The class's row, or that of what is ignored.
  classOf(name) { return this.classes.find((row) => row.name === name) ?? (name === this.ignore.name ? this.ignore : undefined); }

  choose(name) {
    if (name !== this.chosen) this.object = 0;
    this.chosen = name;
    this.changed();
  }

  get nextObject() { return 1 + Math.max(this.object, ...this.marks.map(({object}) => object ?? 0)); }

  /// The clicks that follow are on another thing of the chosen class.
  another() {
    if (!this.classes.some(({name}) => name === this.chosen)) return this.messages.tell('First choose the class of the thing.');
    this.object = this.nextObject;
    this.messages.tell(`The next clicks are on another "${this.chosen}".`);
    this.changed();
  }

  add(event, undoable = true) {
    const whole = {id: this.ids.next(), ...event};
    this.everyEvent.set(whole.id, whole);
    this.pending.push({event: whole, revision: null});
    if (undoable) {
      this.undoable = [...this.undoable, whole].slice(-kMostHistory);
      this.redoable = [];
    }
    this.keep();
    this.queue.add(whole);
    this.settle();
    return whole;
  }

  /// What a label says beside its place: what the person sees as chosen when it begins.
  get label() { return {class: this.chosen, ...(this.object > 0 ? {object: this.object} : {})}; }

  within(view, points) {
    const {width, height} = this.state.views[view];
    return points.map(([x, y]) => [Math.min(Math.max(x, 0), width - 0.01), Math.min(Math.max(y, 0), height - 0.01)]);
  }

  /// A click (one point) or a stroke in pixels of the view; the last event of it.
  click(view, points, radius, label = this.label) {
    const {frame, width, height} = this.state.views[view];
    const parts = strokeParts(this.within(view, points), Math.max(0.7, radius / 3));
    return parts.map((part) => this.add({type: 'click', frame, size: [width, height], points: part, radius, ...label})).at(-1);
  }

  /// The inside of an outline; `step`: corners that lie nearer to the one before are left out.
  polygon(view, points, step, label = this.label) {
    const {frame, width, height} = this.state.views[view];
    const corners = outlineCorners(this.within(view, points), step);
    if (corners.length < 3) return this.messages.tell('A polygon needs three corners.');
    this.add({type: 'click', frame, size: [width, height], points: corners, radius: 0, fill: true, ...label});
  }

  /// Pieces of one thing, which nobody has named before.
  thing(view, outlines, label) {
    const object = label.class === this.ignore.name ? {} : {object: this.nextObject};
    for (const outline of outlines) this.polygon(view, outline, 0, {class: label.class, ...object});
    this.messages.tell(`Labelled: a thing of "${label.class}".`);
  }

  /// Takes marks away, each as an undo of its event, which can itself be undone.
  erase(marks) {
    for (const mark of marks) {
      if (!this.everyEvent.has(mark.id)) this.everyEvent.set(mark.id, this.eventOf(mark));
      this.add({type: 'undo', of: mark.id});
    }
    if (marks.length) this.messages.tell(marks.length === 1 ? `Deleted: ${this.inWords(this.eventOf(marks[0]))}` : `Deleted: ${marks.length} clicks`);
  }

  eventOf(mark) {
    return {id: mark.id, type: 'click', frame: this.state.views[mark.view].frame, points: mark.points, fill: mark.fill, class: mark.name, ...(mark.object ? {object: mark.object} : {})};
  }

  mergeClass(name, into) {
    const {clicks} = this.classOf(name);
    this.add({type: 'merge', class: name, into});
    if (this.chosen === name || this.chosen === null) this.choose(into);
    this.messages.tell(`"${name}" is merged into "${into}", which got its ${clicks} click${clicks === 1 ? '' : 's'}.`);
  }

  deleteClass(name) {
    const {clicks} = this.classOf(name);
    this.add({type: 'delete', class: name});
    this.messages.tell(`"${name}" is deleted${clicks ? ` with ${clicks} click${clicks === 1 ? '' : 's'}` : ''}; ${byHand('z', 'undo')} brings it back.`);
  }

  addClass(name, color) {
    this.add({type: 'class', name, color});
    this.choose(name);
  }

  changeClass(old, name, color) {
    this.add({type: 'rename', class: old, name, color});
    if (this.chosen === old) this.chosen = name;
    this.settle();
  }

  takeProposal({id, view, at}, radius, label) {
    this.skipped = id;
    this.click(view, [at], radius, label);
  }

  skipProposal({id, view, at}) {
    const {frame, width, height} = this.state.views[view];
    this.skipped = id;
    this.add({type: 'skip', frame, size: [width, height], points: [at]});
  }

  /// Undoes the last own event; after a new start the last click of this browser.
  undo() {
    let event = this.undoable.pop();
    if (!event) {
      const mark = this.marks.findLast(({id}) => this.ids.isOurs(id));
      if (mark) event = this.eventOf(mark);
    }
    if (!event) return this.messages.tell('There is nothing to undo.');
    if (!this.everyEvent.has(event.id)) this.everyEvent.set(event.id, event);
    this.redoable.push(this.add({type: 'undo', of: event.id}, false));
    this.keep();
    this.messages.tell(`Undone: ${this.inWords(event)}`);
  }

  redo() {
    const undo = this.redoable.pop();
    if (!undo) return this.messages.tell('There is nothing to redo.');
    const event = this.everyEvent.get(undo.of);
    this.undoable.push(event);
    this.add({type: 'undo', of: undo.id}, false);
    if (event.type === 'class') this.choose(event.name);
    this.messages.tell(`Done again: ${this.inWords(event)}`);
  }

  forget(event) {
    const others = (entry) => entry.id !== event.id;
    this.pending = this.pending.filter((item) => others(item.event));
    this.undoable = this.undoable.filter(others);
    this.redoable = this.redoable.filter(others);
    this.keep();
    this.settle();
  }

  get storageKey() { return `semfield.done.${this.state.run.id}`; }
  keep() { store(this.storage, this.storageKey, {undoable: this.undoable, redoable: this.redoable}); }

  remembered() {
    const {undoable = [], redoable = []} = stored(this.storage, this.storageKey, {});
    Object.assign(this, {undoable, redoable});
    for (const event of [...this.undoable, ...this.redoable]) this.everyEvent.set(event.id, event);
    for (const undo of this.redoable) if (!this.everyEvent.has(undo.of)) this.redoable = [];
  }
}

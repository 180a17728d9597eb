// What the labelling page and the viewer share: a canvas with one camera that is drawn at most once a frame, the pointer, keys and their help, messages, and
// the line about the connection.
import {followState, sentence} from './api.js';
import {byHand, byId, make, setText} from './dom.js';
import {followPointer} from './pointer.js';

/// Messages over the canvas: errors stay until they are closed, others go after a while.
export class Messages {
  constructor() { this.list = byId('messages'); }

  tell(text) {
    this.list.querySelector('.word')?.remove();
    const message = make('div', {class: 'word'}, text);
    this.list.append(message);
    setTimeout(() => message.remove(), 3500);
  }

  /// All is saved: messages about saving are over.
  settled() {
    for (const message of this.list.querySelectorAll('.passes')) message.remove();
  }

  /// One message under a name, for as long as `what` says something.
  hold(name, what, remedy) {
    const shown = this.list.querySelector(`[data-name="${name}"]`);
    if (shown?.dataset.text === what || (!shown && !what)) return;
    shown?.remove();
    if (what) this.list.append(errorOf(what, remedy, {'data-name': name, 'data-text': what}));
  }

  /// A request that was wrong; others are made again.
  wrong(error) {
    if (error.status === 400) this.refuse(error.message, error.remedy);
  }

  refuse(what, remedy, passes = false) {
    const text = `${what} ${remedy}`;
    const shown = [...this.list.querySelectorAll('.error')];
    if (shown.some(({dataset}) => dataset.text === text)) return;
    for (const old of shown.slice(0, -2)) old.remove();
    const message = errorOf(what, remedy, {'data-text': text}, make('button', {'aria-label': 'Close the message', onclick: () => message.remove()}, 'Close'));
    message.classList.toggle('passes', passes);
    this.list.append(message);
  }
}

const errorOf = (what, remedy, attributes, ...more) => make('div', {class: 'error', role: 'alert', ...attributes},
  make('p', {}, make('b', {}, sentence(what)), ` ${sentence(remedy)}`), ...more);

// Keys of the whole page, left to the control that has the focus where it needs them itself.

/// Keys that the focused element handles.
function isTaken(event) {
  const {target, key} = event;
  if (target.matches('input[type="text"], select, textarea')) return true;
  if (target.matches('input[type="range"]')) return /^(Arrow|Home|End|Page)/.test(key);
  if (target.closest('button, a, summary')) return key === ' ' || key === 'Enter';
  return false;
}

/// 'shift+z', 'ctrl+z', 'ArrowLeft', ' ', '1', 'shift+1' (of the key itself, not of what shift makes of it).
export function nameOfKey(event) {
  const digit = /^Digit([1-9])$/.exec(event.code);
  const isLetter = /^[a-z]$/i.test(event.key);
  const name = digit && event.shiftKey ? digit[1] : isLetter ? event.key.toLowerCase() : event.key;
  const hasShift = event.shiftKey && (digit || isLetter || name.length > 1);
  return `${event.ctrlKey || event.metaKey ? 'ctrl+' : ''}${hasShift ? 'shift+' : ''}${name}`;
}

const hasDialog = () => document.querySelector('dialog[open]') !== null;

/// The dialog of `table`, whose rows name keys and what they do.
function helpDialog(table) {
  const sections = table.map(([title, rows]) => make('section', {}, make('h3', {}, title),
    make('dl', {}, ...rows.flatMap(([keys, what]) => [make('dt', {}, keys), make('dd', {}, what)]))));
  return make('dialog', {id: 'help-dialog', 'aria-labelledby': 'help-title'}, make('form', {method: 'dialog'},
    make('header', {}, make('h2', {id: 'help-title'}, byHand('Keys and mouse', 'Help')), make('span', {class: 'gap'}), make('button', {}, 'Close')),
    make('div', {id: 'help-tables'}, ...sections)));
}

const kLost = 'Connection lost, trying again; nothing is lost.';
const kMoved = 'Another run or a new start answers here: open the address that the program prints; nothing is lost.';

export class Page {
  /// camera: of camera.js; mostRatio: of the canvas's pixels to CSS pixels.
  constructor(camera, mostRatio = Infinity) {
    this.changed = this.changed.bind(this);
    this.redraw = this.redraw.bind(this);
    Object.assign(this, {camera, mostRatio, canvas: byId('canvas'), messages: new Messages()});
    new ResizeObserver(() => this.resize()).observe(this.canvas);
  }

  /// The canvas follows the element's size.
  resize() {
    const {clientWidth: width, clientHeight: height} = this.canvas;
    const ratio = Math.min(this.mostRatio, window.devicePixelRatio || 1);
    const {screen} = this.camera;
    if (width === screen.width && height === screen.height && ratio === screen.ratio) return;
    this.canvas.width = Math.max(1, Math.round(width * ratio));
    this.canvas.height = Math.max(1, Math.round(height * ratio));
    this.camera.resize({width, height, ratio});
    this.looked();
  }

  /// Something shown is another: drawn once, before the next frame.
  changed() {
    this.isStale = true;
    this.redraw();
  }

  /// The picture alone is another: the pointer moved.
  redraw() {
    if (this.isScheduled) return;
    this.isScheduled = true;
    requestAnimationFrame(() => {
      this.isScheduled = false;
      if (this.isStale) this.update();
      else this.draw();
    });
  }

  update() {
    this.isStale = false;
    this.draw();
  }

  /// What is shown is another: values of the page or a part of it.
  set(part, values) {
    Object.assign(part, values);
    this.changed();
  }

  /// The camera does something: 'fit', 'move', 'zoom', or what else it can.
  look(how, ...values) {
    this.camera[how](...values);
    this.looked();
  }
  looked() { this.redraw(); }

  /// calls: as followPointer takes them, but for what moves the camera.
  followHand(calls) {
    followPointer(this.canvas, {pan: (dx, dy) => this.look('move', dx, dy), zoom: (factor, x, y) => this.look('zoom', factor, x, y), ...calls});
  }

  /// Rows of the key table that move the camera.
  lookKeys() {
    const closer = () => this.look('zoom', 1.25);
    return [
      ['wheel, pinch, + -', 'zoom', {'+': closer, '=': closer, '-': () => this.look('zoom', 0.8)}],
      ['right drag, two fingers', 'move the picture (alt+drag too)'],
      ['0', 'fit the picture', {0: () => this.look('fit')}],
    ];
  }

  /// table: [title, [[keys and gestures as the help names them, what they do, actions by the names of nameOfKey], ...]], ... Buttons with data-act do the
  /// same as their key. `fingers`: what the help names where there are no keys.
  followKeys(table, fingers = table) {
    const help = helpDialog(byHand(table, fingers));
    document.body.append(help);
    const actions = Object.assign({'?': () => help.showModal()}, ...table.flatMap(([, rows]) => rows.map(([, , acts]) => acts)));
    for (const button of document.querySelectorAll('[data-act]')) button.addEventListener('click', () => actions[button.dataset.act]());
    addEventListener('keydown', (event) => {
      if (hasDialog() || event.isComposing || event.defaultPrevented || isTaken(event)) return;
      const action = event.altKey ? undefined : actions[nameOfKey(event)];
      if (!action) return;
      event.preventDefault();
      action(event);
    });
    // After a press with the mouse the keys belong to the view again.
    const giveBack = () => { if (!hasDialog()) this.canvas.focus({preventScroll: true}); };
    document.addEventListener('click', (event) => { if (event.detail > 0 && event.target.closest('button')) giveBack(); });
    document.addEventListener('change', (event) => { if (event.target.matches('select')) giveBack(); });
    document.addEventListener('pointerup', (event) => { if (event.target.matches('input[type="range"]')) giveBack(); });
  }

  /// From now on take(state, anew) gets what the program tells, and the line about the connection says whether it does.
  followProgram() {
    this.tellConnection('connecting', 'waiting');
    followState({
      state: (value, anew) => {
        this.tellConnection('connected');
        this.take(value, anew);
      },
      lost: (error) => this.tellConnection(error.isElsewhere ? kMoved : kLost, 'lost'),
    });
  }

  /// kind: '', 'waiting' or 'lost'.
  tellConnection(words, kind = '') {
    setText(byId('connection'), words);
    byId('connection').className = kind;
  }
}

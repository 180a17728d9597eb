// Dialogs: name and colour of a class; and what each key of the labelling page does, and what a person set.
import {byId, cssColor, freeColor, hexColor, kPalette, make, rgbOfHex, safeStorage, setText, store, stored} from './dom.js';
import {nameProblem} from './model.js';

// What is answered is done inside the event that answers: a dialog's close event, or a promise, comes after clicks that a person made
// when the dialog was gone already.

/// Opens a dialog; returns end(value), which passes the first value on to answered(): null when the dialog closes without one.
function opened(dialog, answered) {
  dialog.onclose?.();  // of the answer before, whose event is still to come
  let isOpen = true;
  const end = (value) => {
    if (!isOpen) return;
    isOpen = false;
    answered(value);
  };
  dialog.onclose = () => { if (!dialog.open) end(null); };
  dialog.showModal();
  return end;
}

/// told(): somebody clicked beside an open dialog, or on what it covers.
export function followClicksBeside(told) {
  for (const dialog of document.querySelectorAll('dialog')) {
    dialog.addEventListener('pointerdown', ({target, clientX, clientY}) => {
      const {left, right, top, bottom} = dialog.getBoundingClientRect();
      if (target === dialog && (clientX < left || clientX > right || clientY < top || clientY > bottom)) told();
    });
  }
}

/// Asks a question with one answer that does something; answered(whether it was given).
export function ask(title, text, yes, answered) {
  const dialog = byId('question');
  setText(byId('question-title'), title);
  setText(byId('question-text'), text);
  setText(byId('question-yes'), yes);
  const end = opened(dialog, (value) => answered(value === 'yes'));
  dialog.querySelector('form').onsubmit = ({submitter}) => end(submitter?.value);
}

/// The part of the dialog that ends a class; calls end({mergeInto}) or end({isDeleted}).
function offerEnds(row, others, end) {
  byId('class-more').hidden = !row;
  if (!row) return;
  const clicks = `${row.clicks} click${row.clicks === 1 ? '' : 's'}`;
  setText(byId('class-more-title'), row.own ? 'The scene names this class: its colour alone can change.' : `Merge it into another class, or delete it with its ${clicks}`);
  byId('class-end').hidden = row.own;
  const select = byId('merge-into');
  select.replaceChildren(...others.map(({name}) => make('option', {value: name}, name)));
  select.hidden = byId('class-merge').hidden = others.length === 0;
  byId('class-merge').onclick = () => end({mergeInto: select.value});
  byId('class-delete').onclick = () => end({isDeleted: true});
}

/// Asks for a class's name and colour. `row`: the class to change, or null for a new one. answered({name, color}, {mergeInto: name},
/// {isDeleted: true} or null).
export function askClass(classes, row, answered) {
  const dialog = byId('class-dialog');
  const input = byId('class-name');
  const picker = byId('class-color');
  const others = classes.filter((other) => other !== row);
  let color = row?.color ?? freeColor(classes.map((other) => other.color));
  setText(byId('class-dialog-title'), row ? `Change "${row.name}"` : 'New class');
  setText(byId('class-ok'), row ? 'Change it' : 'Make it');
  setText(byId('class-problem'), '');
  input.value = row?.name ?? '';
  input.disabled = Boolean(row?.own);

  const offered = kPalette.some((rgb) => hexColor(rgb) === hexColor(color)) ? kPalette : [color, ...kPalette.slice(0, -1)];
  const swatches = offered.map((rgb) => {
    const swatch = make('button', {type: 'button', role: 'radio', title: hexColor(rgb), 'aria-label': hexColor(rgb)});
    swatch.style.setProperty('--color', cssColor(rgb));
    swatch.addEventListener('click', () => pick(rgb));
    return swatch;
  });
  const pick = (rgb) => {
    color = rgb;
    picker.value = hexColor(rgb);
    let any = false;
    swatches.forEach((swatch, i) => {
      const on = hexColor(offered[i]) === hexColor(rgb);
      any ||= on;
      swatch.setAttribute('aria-checked', on);
      swatch.tabIndex = on ? 0 : -1;
    });
    if (!any) swatches[0].tabIndex = 0;
  };
  pick(color);
  const group = byId('swatches');
  group.replaceChildren(...swatches);
  group.onkeydown = (event) => {
    const step = {ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1}[event.key];
    if (!step) return;
    event.preventDefault();
    const next = (swatches.indexOf(document.activeElement) + step + swatches.length) % swatches.length;
    pick(offered[next]);
    swatches[next].focus();
  };
  picker.oninput = () => pick(rgbOfHex(picker.value));

  const end = opened(dialog, (answer) => {
    dialog.close();
    answered(answer);
  });
  offerEnds(row, others, end);
  dialog.querySelector('form').onsubmit = (event) => {
    event.preventDefault();
    const name = input.value.trim();
    const problem = nameProblem(name, others.map((other) => other.name));
    setText(byId('class-problem'), problem);
    if (problem) input.focus();
    else end({name, color});
  };
  byId('class-cancel').onclick = () => end(null);
  input.focus();
  input.select();
}

/// The help where fingers do it all.
export const kFingers = [
  ['Label', [
    ['tap, drag', 'label with the chosen class: a place, a stroke'],
    ['polygon, thing, eraser', 'each says what it does when you choose it'],
    ['tap a click', 'with its own class chosen: select it, to delete it'],
    ['tap the class', 'that is chosen: rename, merge or delete it'],
    ['Another', 'the next clicks are on another thing of the chosen class'],
  ]],
  ['Look', [['two fingers', 'move the picture, and zoom']]],
];

/// What each key does, as Page.followKeys takes it.
export function keyTable(page) {
  const {stage, labeller, settings} = page;
  const {tools} = stage;
  const undo = () => labeller.undo();
  const redo = () => labeller.redo();
  const remove = () => page.remove();
  const each = (keys, act) => Object.fromEntries(keys.map((key, i) => [key, () => act(key, i)]));
  const kArrows = ['ArrowLeft', 'ArrowUp', 'ArrowRight', 'ArrowDown'];
  const cross = (held, isFine) => each(kArrows.map((key) => held + key), (_, i) => stage.moveCross(...[[-1, 0], [0, -1], [1, 0], [0, 1]][i], isFine));
  const give = (digit) => {
    if (!page.classes.some(({name}) => name === labeller.chosen)) return page.messages.tell('First choose the class for this key.');
    settings.give(labeller.chosen, digit);
    page.changed();
  };
  return [
    ['Label', [
      ['click, drag', 'label with the chosen class: a place, a stroke'],
      ['b', 'brush', {b: () => tools.use('brush')}],
      ['p', 'polygon: click corners or drag; enter or the first corner closes it, backspace takes a corner back',
       {p: () => tools.use('polygon'), Backspace: () => { if (!tools.takeBack()) remove(); }}],
      ['m', 'thing: point at one, click, and click again or enter to label it; the wheel grows and shrinks it, a stroke splits off or adds', {m: () => tools.use('thing')}],
      ['x', 'eraser: click or drag over clicks to delete them', {x: () => tools.use('erase')}],
      ['del', 'delete the click under the pointer, or the selected one (click it with its own class)', {Delete: remove}],
      ['1 ... 9', 'choose a class', each([...'123456789'], (digit) => page.chooseByKey(digit))],
      ['shift+1 ... 9', 'give the chosen class this key', each([...'123456789'].map((digit) => `shift+${digit}`), (key) => give(key.at(-1)))],
      [', .', 'the class before, the next', {',': () => page.neighbourClass(-1), '.': () => page.neighbourClass(1)}],
      ['c', 'choose the class under the pointer', {c: () => page.chooseSeen()}],
      ['n', 'make a class', {n: () => page.make()}],
      ['a', 'another thing of the chosen class: the next clicks are on it', {a: () => labeller.another()}],
      ['F2', 'rename, merge or delete the chosen class (or double click)', {F2: () => page.change(labeller.classOf(labeller.chosen))}],
      ['i', 'ignore: what nobody should label', {i: () => page.choose(labeller.ignore.name)}],
      ['[ ]', 'smaller brush or thing, larger', {'[': () => tools.resize(-1), ']': () => tools.resize(1)}],
      ['z, shift+z', 'undo, do again', {'z': undo, 'ctrl+z': undo, 'shift+z': redo, 'ctrl+shift+z': redo, 'ctrl+y': redo}],
    ]],
    ['Proposed click', [
      ['space', 'go to it; there: label it with the chosen class', {' ': () => page.space()}],
      ['g', 'label it with the class that the model guesses', {g: () => page.takeGuess()}],
      ['s', 'skip it', {s: () => { const proposal = page.seenProposal(false); if (proposal) labeller.skipProposal(proposal); }}],
    ]],
    ['Look', [
      ...page.lookKeys(),
      ['arrows', 'the view before, the next', each(kArrows, (_, i) => page.step(i < 2 ? -1 : 1))],
      ['home, end', 'the first view, the last', {Home: () => page.show(page.strip.shown[0]), End: () => page.show(page.strip.shown.at(-1))}],
      ['r', 'photograph or rendered', {r: () => page.set(page, {isRendered: !page.isRendered})}],
      ['e', 'labels or entropy', {e: () => page.set(stage, {kind: stage.kind === 'labels' ? 'entropy' : 'labels', isHidden: false})}],
      ['o', 'overlay off and on', {o: () => page.set(stage, {isHidden: !stage.isHidden})}],
      ['t', 'names of clicks off and on', {t: () => { settings.set({names: !settings.names}); page.changed(); }}],
    ]],
    ['Without a mouse', [
      ['shift+arrows', 'move a cross over the view (with ctrl: by one pixel)', {...cross('shift+', false), ...cross('ctrl+shift+', true)}],
      ['enter', 'click at the cross', {Enter: () => page.enter()}],
      ['esc', 'out of a polygon, a thing or a selection', {Escape: () => { tools.drop(); page.select(null); }}],
    ]],
  ];
}

// What a person set in this browser: opacity, brush, keys of classes. Kept from visit to visit.

const kKey = 'semfield.settings';
const kFirst = {opacity: 55, radius: 3, names: false, digits: {}};

export class Settings {
  constructor(storage = safeStorage('localStorage')) {
    this.storage = storage;
    Object.assign(this, structuredClone(kFirst));
    const kept = stored(storage, kKey, {});
    for (const name of Object.keys(kFirst)) if (typeof kept[name] === typeof kFirst[name]) this[name] = kept[name];
  }

  set(values) {
    Object.assign(this, values);
    const {opacity, radius, names, digits} = this;
    store(this.storage, kKey, {opacity, radius, names, digits});
  }

  /// digit of each class's name: those that a person gave, then the free ones in order.
  keysOf(classes) {
    const keys = new Map();
    const taken = new Set();
    for (const [name, digit] of Object.entries(this.digits)) {
      if (!classes.some((row) => row.name === name) || taken.has(digit)) continue;
      keys.set(name, digit);
      taken.add(digit);
    }
    const free = [...'123456789'].filter((digit) => !taken.has(digit));
    for (const {name} of classes) if (!keys.has(name) && free.length) keys.set(name, free.shift());
    return keys;
  }

  give(name, digit) {
    const digits = Object.fromEntries(Object.entries(this.digits).filter(([, other]) => other !== digit));
    this.set({digits: {...digits, [name]: digit}});
  }
}

// Dialogs: name and colour of a class, and the help.
import {cssColor, freeColor, hexColor, kPalette, rgbOfHex} from './colors.js';
import {byId, make, setText} from './dom.js';
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

const kHelp = [
  ['Label', [
    ['click, drag', 'label with the chosen class: a place, a stroke'],
    ['b', 'brush'],
    ['p', 'polygon: click corners or drag; enter or the first corner closes it, backspace takes a corner back'],
    ['x', 'eraser: click or drag over clicks to delete them'],
    ['del', 'delete the click under the pointer, or the selected one (click it with its own class)'],
    ['1 ... 9', 'choose a class'],
    ['shift+1 ... 9', 'give the chosen class this key'],
    [', .', 'the class before, the next'],
    ['c', 'choose the class under the pointer'],
    ['n', 'make a class'],
    ['a', 'another thing of the chosen class: the next clicks are on it'],
    ['F2', 'rename, merge or delete the chosen class (or double click)'],
    ['i', 'ignore: what nobody should label'],
    ['[ ]', 'smaller brush, larger brush'],
    ['z, shift+z', 'undo, do again'],
  ]],
  ['Proposed click', [
    ['space', 'go to it; there: label it with the chosen class'],
    ['g', 'label it with the class that the model guesses'],
    ['s', 'skip it'],
  ]],
  ['Look', [
    ['wheel, pinch, + -', 'zoom'],
    ['right drag, two fingers', 'move the picture (alt+drag too)'],
    ['0', 'fit the picture'],
    ['arrows', 'the view before, the next'],
    ['home, end', 'the first view, the last'],
    ['r', 'photograph or rendered'],
    ['e', 'labels or entropy'],
    ['o', 'overlay off and on'],
    ['t', 'names of clicks off and on'],
  ]],
  ['Without a mouse', [
    ['shift+arrows', 'move a cross over the view (with ctrl: by one pixel)'],
    ['enter', 'click at the cross'],
  ]],
  ['Fly', [
    ['f', 'fly through the scene; f or esc leaves'],
    ['w a s d, q e', 'move; down, up (with shift: faster)'],
    ['click', 'label what is there, in the photograph that shows it best'],
    ['v', 'go to that photograph, or the nearest'],
    ['drag, arrows', 'look around'],
    ['wheel', 'move ahead or back'],
  ]],
];

export function showHelp() {
  const tables = byId('help-tables');
  if (!tables.childElementCount) {
    for (const [title, rows] of kHelp) {
      const list = make('dl', {}, ...rows.flatMap(([keys, what]) => [make('dt', {}, keys), make('dd', {}, what)]));
      tables.append(make('section', {}, make('h3', {}, title), list));
    }
  }
  byId('help-dialog').showModal();
}

// What lies around the view: tools, the proposed click, what is selected, the welcome and the line at the foot.
import {cssColor} from './colors.js';
import {byId, make, setAttribute, setText} from './dom.js';
import {shapeOf} from './labeller.js';
import {reason} from './model.js';

const kTools = ['brush', 'polygon', 'erase'];

export class Bars {
  /// page: what it shows and does; messages of the page.
  constructor(page, messages) { Object.assign(this, {page, messages}); }

  /// All but the foot, once there is a state.
  update() {
    this.tools();
    this.proposal();
    this.selection();
    this.welcome();
  }

  foot() {
    const {labeller, state, isLost} = this.page;
    const {unsaved} = labeller;
    setText(byId('connection'), isLost ?? (state ? 'connected' : 'connecting'));
    byId('connection').classList.toggle('lost', Boolean(isLost));
    setText(byId('saving'), unsaved ? `${unsaved} not saved yet` : labeller.marks.length ? 'every click is saved' : '');
    byId('saving').classList.toggle('waiting', unsaved > 0);
    if (!unsaved) this.messages.settled();
  }

  tools() {
    const {stage, settings, flight, isRendered, view} = this.page;
    for (const [id, on] of [['show-photo', !isRendered], ['show-rendered', isRendered], ['show-labels', stage.kind === 'labels'],
                            ['show-entropy', stage.kind === 'entropy'], ['fly', flight !== null],
                            ...kTools.map((kind) => [`tool-${kind}`, stage.tools.kind === kind])]) {
      setAttribute(byId(id), 'aria-pressed', on);
    }
    byId('opacity').value = stage.isHidden ? 0 : settings.opacity;
    setText(byId('opacity-value'), stage.isHidden ? 'off' : `${settings.opacity} %`);
    byId('radius').value = settings.radius;
    setText(byId('radius-value'), `${settings.radius} px`);
    byId('legend').hidden = stage.kind !== 'entropy' || flight !== null;
    byId('pad').hidden = !flight;
    byId('canvas').classList.toggle('flying', flight !== null);
    byId('canvas').classList.toggle('locked', Boolean(view?.held_out));
    setAttribute(byId('canvas'), 'aria-label', flight ? 'Free camera' : view ? `View ${view.frame}` : 'No view');
  }

  proposal() {
    const {flight, index, state, classes} = this.page;
    const {proposal, chosen} = this.page.labeller;
    const text = byId('proposal-text');
    const isHere = proposal?.view === index && !flight;
    const none = classes.length === 0;
    const guess = classes.find(({index}) => index >= 0 && index === proposal?.class_guess);
    text.classList.toggle('some', Boolean(proposal) && !flight);
    byId('to-photograph').hidden = !flight;
    setText(text, flight ? 'Flying: w a s d q e move, drag looks around, a click labels, f leaves.'
      : !proposal ? 'No click is proposed at the moment.'
      : `Click proposed ${isHere ? 'here' : `in ${state.views[proposal.view].frame}`}: ${reason(proposal.why)}.`);
    const take = byId('proposal-take');
    take.hidden = byId('proposal-skip').hidden = !proposal || flight !== null;
    this.fill(take, !isHere ? ['Go to it'] : chosen !== null ? ['Label as ', {...this.page.classOf(chosen), name: this.page.classOf(chosen).label ?? chosen}] : [none ? 'Name it' : 'Choose a class'], isHere && chosen === null && !none ? '' : 'space');
    take.disabled = isHere && chosen === null && !none;
    const button = byId('proposal-guess');
    button.hidden = take.hidden || !isHere || !guess || guess.name === chosen;
    if (!button.hidden) this.fill(button, ['Guess: ', guess], 'g');
  }

  selection() {
    const {stage, flight} = this.page;
    const mark = stage.marks.find(({id}) => id === stage.selected);
    byId('selection').hidden = !mark || flight !== null;
    if (mark) setText(byId('selection-text'), `Selected: ${shapeOf(mark)} "${mark.label}"`);
  }

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

  welcome() {
    const welcome = byId('welcome');
    const {flight, view, classes, labeller} = this.page;
    const {views} = this.page.state;
    const hasMarks = labeller.marks.length > 0;
    const words = view?.held_out ? null : views.length === 0 ? ['There is no view to label', 'The scene has no training frame.']
      : classes.length === 0 ? ['Name the first class', 'Press n, or click on something in the picture. Colour and geometry are being learned already; ' +
          'labels of all views follow within a second of the first clicks.']
      : !hasMarks && labeller.chosen === null ? ['Choose a class, then click', 'Keys 1 to 9 choose a class, n makes one. A click, or a drag along something, labels it.']
      : !hasMarks ? [`Click on something that is "${this.page.classOf(labeller.chosen).label ?? labeller.chosen}"`, 'Or drag along it. Keys 1 to 9 choose another class, n makes one.'] : null;
    welcome.hidden = !words || flight !== null;
    if (words && this.welcomed !== words[0]) welcome.replaceChildren(make('h2', {}, words[0]), make('p', {}, words[1]));
    this.welcomed = words?.[0];
  }
}

// The right side: classes, exports and notes; and the line at the foot.
import {photoAddress, postJson} from './api.js';
import {byHand, byId, cssColor, make, refill, setAttribute, setPressed, setStyle, setText, showLegend, swatch} from './dom.js';
import {shapeOf} from './labeller.js';
import {duration, orderedViews, reason, short} from './model.js';

// What lies around the view: tools, the proposed click, what is selected, the welcome and the line at the foot.

const kTools = ['brush', 'polygon', 'thing', 'erase'];

export class Bars {
  constructor(page) { this.page = page; }

  /// All but the foot, once there is a state.
  update() {
    this.tools();
    this.proposal();
    this.selection();
    this.welcome();
  }

  foot() {
    const {labeller} = this.page;
    const {unsaved} = labeller;
    setText(byId('saving'), unsaved ? `${unsaved} not saved yet` : labeller.marks.length ? 'every click is saved' : '');
    byId('saving').classList.toggle('waiting', unsaved > 0);
    if (!unsaved) this.page.messages.settled();
  }

  tools() {
    const {stage, settings, isRendered, view} = this.page;
    const tools = kTools.map((kind) => [`tool-${kind}`, stage.tools.kind === kind]);
    const overlays = ['labels', 'entropy'].map((kind) => [`show-${kind}`, stage.kind === kind]);
    setPressed({'show-photo': !isRendered, 'show-rendered': isRendered, ...Object.fromEntries([...overlays, ...tools])});
    byId('opacity').value = stage.isHidden ? 0 : settings.opacity;
    setText(byId('opacity-value'), stage.isHidden ? 'off' : `${settings.opacity} %`);
    byId('radius').value = settings.radius;
    setText(byId('radius-value'), `${settings.radius} px`);
    showLegend(stage.kind === 'entropy' ? ['certain', 'uncertain'] : null);
    byId('canvas').classList.toggle('locked', Boolean(view?.held_out));
    setAttribute(byId('canvas'), 'aria-label', view ? `View ${view.frame}` : 'No view');
  }

  proposal() {
    const {index, state, classes} = this.page;
    const {proposal, chosen} = this.page.labeller;
    const text = byId('proposal-text');
    const isHere = proposal?.view === index;
    const none = classes.length === 0;
    const guess = classes.find(({index}) => index >= 0 && index === proposal?.class_guess);
    text.classList.toggle('some', Boolean(proposal));
    setText(text, !proposal ? (state.run.geometry_ready ? 'No click is proposed at the moment.' : 'Clicks are proposed once the surface is known.')
      : `Click proposed ${isHere ? 'here' : `in ${state.views[proposal.view].frame}`}: ${reason(proposal.why)}.`);
    const take = byId('proposal-take');
    take.hidden = byId('proposal-skip').hidden = !proposal;
    this.fill(take, !isHere ? ['Go to it'] : chosen !== null ? ['Label as ', {...this.page.labeller.classOf(chosen), name: this.page.labeller.classOf(chosen).label ?? chosen}] : [none ? 'Name it' : 'Choose a class'], isHere && chosen === null && !none ? '' : 'space');
    take.disabled = isHere && chosen === null && !none;
    const button = byId('proposal-guess');
    button.hidden = take.hidden || !isHere || !guess || guess.name === chosen;
    if (!button.hidden) this.fill(button, ['Guess: ', guess], 'g');
  }

  selection() {
    const {stage} = this.page;
    const mark = stage.marks.find(({id}) => id === stage.selected);
    byId('selection').hidden = !mark;
    if (mark) setText(byId('selection-text'), `Selected: ${shapeOf(mark)} "${mark.label}"`);
  }

  /// A button's words, a class with its swatch among them, and its key.
  fill(button, parts, key) {
    const shown = (part) => (typeof part === 'string' ? [part] : [swatch(part.color), part.name]);
    refill(button, [parts, key], () => [...parts.flatMap(shown), ...(key ? [' ', make('kbd', {}, key)] : [])]);
  }

  welcome() {
    const welcome = byId('welcome');
    const {view, classes, labeller} = this.page;
    const {views} = this.page.state;
    const hasMarks = labeller.marks.length > 0;
    const words = view?.held_out ? null : views.length === 0 ? ['There is no view to label', 'The scene has no training frame.']
      : classes.length === 0 ? ['Name the first class', `${byHand('Press n, or click on', 'Tap')} something in the picture. Soon after the first labels, all views have some.`]
      : !hasMarks && labeller.chosen === null ? [`Choose a class, then ${byHand('click', 'tap')}`,
        byHand('Keys 1 to 9 choose a class, n makes one. A click, or a drag along something, labels it.', 'A tap, or a drag along something, labels it. Two fingers move the picture.')]
      : !hasMarks ? [`${byHand('Click on', 'Tap')} something that is "${labeller.classOf(labeller.chosen).label ?? labeller.chosen}"`,
        `Or drag along it. ${byHand('Keys 1 to 9 choose another class, n makes one.', 'Two fingers move the picture.')}`] : null;
    welcome.hidden = !words;
    if (words) refill(welcome, words, () => [make('h2', {}, words[0]), make('p', {}, words[1])]);
  }
}

const kWords = {labels: 'Label images', coco: 'COCO', mesh: 'Mesh'};
const percent = (share) => (share >= 0.0995 ? `${Math.round(100 * share)}` : (100 * share).toFixed(1));

const kMostUnreached = 0.05;

/// Why certainty says nothing yet, or '': what is seen of a class without a click passes for another class, surely.
export function unsureYet(classes, unreached) {
  const bare = classes.filter(({clicks, area_share}) => !clicks && !area_share);
  const made = bare.find(({own}) => !own);
  if (made) return `"${made.name}" has no click yet`;
  const hasAll = bare.length === 0 && classes.some(({own}) => own);
  return unreached > kMostUnreached && !hasAll ? `no click reaches ${percent(unreached)} % of the surface yet` : '';
}

export class Panel {
  constructor(page) {
    this.page = page;
    this.rows = [];
    for (const button of document.querySelectorAll('#exports button')) {
      button.addEventListener('click', () => {
        page.messages.tell('The export is begun; it is listed here when it is done.');
        this.send({what: button.dataset.what});
      });
    }
    byId('classes').addEventListener('keydown', (event) => {
      const step = {ArrowDown: 1, ArrowUp: -1}[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      const at = this.rows.findIndex(({item}) => item === document.activeElement);
      const row = this.rows[Math.min(Math.max(at + step, 0), this.rows.length - 1)];
      row.item.focus();
      page.choose(row.shown.name);
    });
  }

  addRow() {
    const row = {shown: null};
    const parts = ['key', 'swatch', 'name', 'clicks', 'area', 'sure'].map((name) => make('span', {class: name}));
    [row.key, row.swatch, row.name, row.clicks, row.area, row.sure] = parts;
    row.item = make('button', {
      role: 'radio',
      onclick: () => (byHand(false, row.shown.name === this.page.labeller.chosen) ? this.page.change(row.shown) : this.page.choose(row.shown.name)),
      ondblclick: () => this.page.change(row.shown),
      onpointerenter: () => this.page.stage.point(row.shown.name),
      onpointerleave: () => this.page.stage.point(null),
    }, ...parts);
    this.rows.push(row);
    byId('classes').append(row.item);
  }

  /// keys: digit of a class's name, or none; ignore: the row of what is ignored.
  updateClasses(classes, ignore, chosen, keys, {room, run}) {
    setAttribute(byId('ignore'), 'aria-pressed', chosen === ignore.name);
    setText(byId('ignore').querySelector('.clicks'), ignore.clicks ? String(ignore.clicks) : '');
    while (this.rows.length < classes.length) this.addRow();
    while (this.rows.length > classes.length) this.rows.pop().item.remove();
    const unsure = unsureYet(classes, run.unreached);
    const hasChosen = classes.some(({name}) => name === chosen);
    classes.forEach((shown, i) => {
      const row = this.rows[i];
      row.shown = shown;
      const key = keys.get(shown.name) ?? '';
      const hasArea = shown.area_share > 0;
      const area = !run.geometry_ready && !hasArea ? '\u2026' : `${percent(shown.area_share)} %`;
      const sure = unsure ? '\u2013' : `${Math.round(100 * shown.confidence)} %`;
      const isSeen = hasArea || shown.clicks > 0;
      const cells = {key, name: shown.name, clicks: shown.clicks || '', area: isSeen ? area : '', sure: isSeen && (hasArea || unsure) ? sure : ''};
      for (const [cell, text] of Object.entries(cells)) setText(row[cell], String(text));
      setAttribute(row.sure, 'title', unsure ? `Shown once every class that is seen has a click: ${unsure}.` : 'Mean certainty over the area');
      setStyle(row.swatch, '--color', cssColor(shown.color));
      setAttribute(row.item, 'aria-checked', shown.name === chosen);
      setAttribute(row.item, 'tabindex', shown.name === chosen || (!hasChosen && i === 0) ? 0 : -1);
      const told = shown.saved ? '' : ', not saved yet';
      setAttribute(row.item, 'aria-label', `${shown.name}${key ? `, key ${key}` : ''}, ${shown.clicks} clicks, ${area} of the area, ${unsure ? 'certainty not known yet' : `${sure} sure`}${told}`);
      setAttribute(row.item, 'title', `${shown.name}${told}: click to choose, double click to rename, merge or delete`);
      row.item.classList.toggle('unsaved', !shown.saved);
    });
    setText(byId('room'), `${classes.length} of ${room.most}`);
    setAttribute(byId('room'), 'title', `This run has room for ${room.most} classes`);
    byId('new-class').disabled = classes.length >= room.most;
  }

  updateRun(state) {
    this.updateExports(state.exports ?? []);
    const notes = (state.notes ?? []).slice(-5);
    byId('notes').hidden = notes.length === 0;
    const words = (note) => note.split('`').map((part, i) => (i % 2 ? make('code', {}, part) : part));
    refill(byId('notes'), notes, () => [make('summary', {}, make('h2', {}, `Notes (${notes.length})`)), ...notes.map((note) => make('p', {}, ...words(note)))]);
    const {run} = state;
    const psnr = run.psnr ? `PSNR ${run.psnr.toFixed(1)} dB` : '';
    const parts = [run.name, run.phase, `step ${run.step.toLocaleString('en')}`, psnr, duration(run.train_s), `${short(run.rays_per_s)} rays/s`, run.device];
    setText(byId('run-line'), parts.filter(Boolean).join('  ·  '));
    setAttribute(byId('run-line'), 'title', run.folder);
  }

  /// Begins or cancels an export.
  send(request) { postJson('./export', request).catch((error) => this.page.messages.refuse(error.message, error.remedy)); }

  updateExports(exports) {
    refill(byId('export-list'), exports, () => exports.toReversed().map(({id, what, state, text, files}) => {
      const links = (files ?? []).map((name, n) => make('a', {href: `./export/${encodeURIComponent(id)}/${n}`, download: name.split('/').at(-1)}, name));
      const many = links.length > 3;
      const list = make('div', {class: 'files'}, ...links);
      const body = many ? make('details', {}, make('summary', {}, `${links.length} files`), list) : list;
      const open = state === 'waiting' || state === 'running';
      const cancel = open ? make('button', {title: `Cancel the export ${id}`}, 'Cancel') : null;
      cancel?.addEventListener('click', () => { cancel.disabled = true; this.send({cancel: id}); });
      return make('div', {class: `export ${state}`}, make('p', {}, make('b', {}, `${kWords[what] ?? what}: ${state}`), text ? ` ${text}` : ''),
                  ...(state === 'running' ? [progressOf(text, `${kWords[what] ?? what} is being written`)] : []), ...(open ? [cancel] : []), ...(links.length ? [body] : []));
    }));
  }
}

/// A bar as long as the "3/35" in what the program says of its progress.
function progressOf(text, label) {
  const [, done, all] = /(\d+)\/(\d+)/.exec(text) ?? [];
  return make('progress', {'aria-label': label, ...(all ? {value: done, max: all} : {})});
}

// The strip of views: thumbnails that load when they come into sight, clicks and entropy.

export class Strip {
  constructor(page) {
    this.list = byId('strip');
    this.order = byId('order');
    this.items = [];
    this.shown = [];
    this.seen = new IntersectionObserver((entries) => {
      for (const {isIntersecting, target} of entries) {
        if (!isIntersecting) continue;
        this.seen.unobserve(target);
        const image = target.querySelector('img');
        image.src = photoAddress(target.dataset.view, target.dataset.photo, 160);
        image.addEventListener('error', () => setTimeout(() => this.seen.observe(target), 3000), {once: true});
      }
    }, {root: this.list, rootMargin: '200px'});
    this.order.addEventListener('change', () => this.arrange());
    this.list.addEventListener('click', (event) => {
      const button = event.target.closest('button');
      if (button) page.show(Number(button.dataset.view));
    });
  }

  build(views) {
    this.list.replaceChildren();
    this.items = views.map((view, i) => {
      const image = make('img', {alt: '', draggable: 'false', width: view.width, height: view.height});
      const name = make('span', {class: 'name'}, make('bdi', {dir: 'ltr'}, view.frame));
      const clicks = make('span', {class: 'clicks'});
      const bar = make('span', {class: 'bar'}, make('i'));
      const badge = view.held_out ? [make('span', {class: 'badge'}, 'test')] : [];
      const button = make('button', {'data-view': i, tabindex: -1, title: view.frame}, image, name, clicks, view.held_out ? '' : bar, ...badge);
      const item = make('li', {}, button);
      return {item, button, clicks, fill: bar.firstChild};
    });
    this.arrangement = '';
  }

  /// clicks: of each view, those included that are not saved yet.
  update(views, clicks, current, proposed) {
    this.views = views.map((view, i) => ({...view, clicks: clicks[i]}));
    if (this.items.length !== views.length) this.build(views);
    setText(byId('views-title'), `${views.length} view${views.length === 1 ? '' : 's'}`);
    views.forEach((view, i) => {
      const {button, clicks: count, fill} = this.items[i];
      if (button.dataset.photo !== view.photo) {
        button.dataset.photo = view.photo;
        this.seen.unobserve(button);
        this.seen.observe(button);
      }
      const percent = Math.round(100 * view.entropy);
      setText(count, clicks[i] ? String(clicks[i]) : '');
      setStyle(fill, 'width', `${percent}%`);
      const label = view.held_out ? `${view.frame}: held out for tests, only to look at` : `${view.frame}: ${clicks[i]} click${clicks[i] === 1 ? '' : 's'}, entropy ${percent} %${i === proposed ? ', click proposed' : ''}`;
      setAttribute(button, 'aria-label', label);
      setAttribute(button, 'title', label);
      setAttribute(button, 'aria-current', i === current);
      setAttribute(button, 'tabindex', i === current ? 0 : -1);
      button.classList.toggle('proposed', i === proposed);
    });
    if (this.current !== current || !this.arrangement) {
      this.current = current;
      this.arrange();
    }
  }

  /// Sorted anew when the person asks or goes to another view, not under the pointer.
  arrange() {
    this.shown = orderedViews(this.views, this.order.value);
    const arrangement = this.shown.join();
    if (arrangement !== this.arrangement) {
      const had = this.list.contains(document.activeElement) ? document.activeElement : null;
      this.list.append(...this.shown.map((i) => this.items[i].item));
      this.arrangement = arrangement;
      had?.focus();
    }
    this.items[this.current]?.item.scrollIntoView({block: 'nearest', inline: 'nearest'});
  }

  /// The view `steps` further along the strip than `view`.
  neighbour(view, steps) {
    const at = this.shown.indexOf(view);
    return this.shown[Math.min(Math.max(at + steps, 0), this.shown.length - 1)];
  }
}

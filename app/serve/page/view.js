// The viewer put together: the mesh of a scene, what a person reads and measures on it, a path of the camera. With a program behind it the field too.
import {OrbitCamera, between, distance} from './camera.js';
import {byId, make, onClick, saveAs, setPressed, setText, showLegend, swatch} from './dom.js';
import {Drawing, Layer, bytesOf, inflated, kGrey, kHidden, kMode, kShown, lengthText, unpacked} from './drawing.js';
import {Live, liveScene} from './live.js';
import {ObjectList} from './objects.js';
import {Messages, Page} from './page.js';

const kStill_ms = 250;                   // the camera stands still
const kMostRatio = 2;                    // of pixels, each of which costs
const kInside = window !== window.parent;  // of another page
const kMark = '#ffd54a';                 // of points and what is measured
const kFlights = {w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0]};

class ViewPage extends Page {
  /// isLive: a program is behind the page, and not a file that stands alone.
  constructor({facts, mesh}, isLive) {
    super(new OrbitCamera(facts), kMostRatio);
    this.drawing = new Drawing(this.canvas);
    Object.assign(this, {layer: new Layer(this.drawing, facts, mesh), isLive, mode: 'photo', points: [], views: []});
    this.objects = new ObjectList(this);
    setText(byId('title'), isLive ? facts.run : facts.title);
    document.title = isLive ? `${facts.run} - Semfield` : facts.title;
    byId('about').lastElementChild.append(...facts.about.map((line) => make('p', {}, line)));
    for (const id of ['class', 'entropy', 'class-list']) byId(id).hidden = !facts.labels;
    this.isFitted = false;
    this.camera.setBox(facts, this.layer.points());
    byId('inside').parentElement.hidden = facts.eye === undefined;
    if (this.canvas.clientWidth < 600 || this.canvas.clientHeight < 600) byId('class-list').open = false;
    this.listClasses();
    this.connect();
    this.resize();
    if (facts.eye === undefined) this.look('fit');
    else this.camera.goInside();
    this.live = isLive ? new Live(this) : null;
  }

  get facts() { return this.layer.facts; }

  /// What the program says: the newest step of the run, and how much of which mesh is made, in thousandths.
  take({newest, mesh, made}, anew) {
    if (made < 1000) this.tellConnection(`${mesh === 2 ? 'A finer mesh' : 'The mesh'} is being made: ${Math.floor(made / 10)} %`, 'waiting');
    if (newest > this.facts.step) this.tellConnection(`Step ${newest} is there: load the page again to see it.`);
    if (anew) this.changed();
  }

  /// Another mesh of the same scene.
  replace(layer) {
    const old = this.layer;
    old.facts.classes.forEach((_, i) => layer.mark(layer.classes, i, old.classes.bytes[4 * i + 3]));
    this.camera.setBox(layer.facts, layer.points());
    old.drop();
    this.layer = layer;
    if (this.isFitted) this.look('fit');
    this.objects.refresh();
  }

  listClasses() {
    const row = ({name, color}, label) => {
      const onchange = ({target}) => {
        this.layer.mark(this.layer.classes, label, target.checked ? kShown : kHidden);
        this.changed();
      };
      return make('li', {}, make('label', {}, make('input', {type: 'checkbox', checked: true, onchange}), swatch(color), name));
    };
    byId('class-list').lastElementChild.append(...[...this.facts.classes, {name: 'no class', color: kGrey}].map(row));
  }

  /// Whether a list hides something, which a rendered picture would show.
  hides() { return document.querySelector('#panel input[type="checkbox"]:not(:checked)') !== null; }

  /// What panel and hint leave of the canvas.
  free() {
    const {width, height} = this.camera.screen;
    const [panel, hint] = ['panel', 'hint'].map((id) => byId(id).getBoundingClientRect());
    const isAside = panel.width < width / 2;
    return {left: isAside ? panel.right : 0, top: isAside ? 0 : panel.bottom, right: width, bottom: hint.height > 0 ? hint.top : height};
  }

  look(how, ...values) {
    this.isFitted = how === 'fit';
    super.look(how, ...(this.isFitted ? [this.free()] : values));
  }

  /// Depths or entropies that colours span.
  range() { return this.mode === 'entropy' ? [0, this.facts.entropy] : this.camera.depths(); }

  /// A room has walls for the field: from outside, its mesh alone is open.
  isBeforeAWall() {
    const {eye, low, high} = this.facts;
    const slack = 0.02 * this.camera.diagonal;  // a scan's cameras may stand outside of what they saw
    return eye !== undefined && this.camera.place.some((v, i) => v < Math.min(low[i], eye[i]) - slack || v > Math.max(high[i], eye[i]) + slack);
  }

  // Buttons, the hand and keys.

  connect() {
    for (const {id} of byId('colors').children) onClick(id, () => this.set(this, {mode: id}));
    onClick('inside', () => this.look('goInside'));
    onClick('picture', async () => saveAs('semfield.png', await this.picture()));
    onClick('add-view', () => this.set(this, {views: [...this.views, this.camera.state()]}));
    onClick('clear', () => this.set(this, {views: []}));
    onClick('save-path', () => saveAs('path.txt', new Blob([this.pathText()])));
    onClick('play', () => this.play());
    let last = [0, 0];
    this.followHand({
      down: (x, y) => { last = [x, y]; },
      draw: (x, y, event) => {
        this.look(event.shiftKey ? 'move' : 'turn', x - last[0], y - last[1]);
        last = [x, y];
      },
      up: (isClick, x, y, event) => { if (isClick) this.point(x, y, event.shiftKey); },
      wheel_px: 500,
      scrolls: () => kInside && document.activeElement !== this.canvas,  // the page around it does
    });
    this.canvas.addEventListener('webglcontextlost', () => this.messages.refuse('The graphics device was lost.', 'Load the page again.'));
    this.flying = new Set();
    addEventListener('keyup', (event) => this.flying.delete(event.key.toLowerCase()));
    addEventListener('blur', () => this.flying.clear());
    this.followKeys(this.keyTable(), [['Look', [['drag', 'turn'], ['pinch', 'come closer'], ['two fingers', 'move the picture']]],
      ['Read', [['tap', 'what a point is, and where; its object'], ['second tap', 'how far it is from the first']]]]);
  }

  keyTable() {
    const turns = {ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20]};
    const each = (ways, act) => Object.fromEntries(Object.keys(ways).map((key) => [key, () => act(key)]));
    const edits = [
      ['F2', 'rename the chosen one', {F2: () => byId('name').select()}],
      ['ctrl+z', 'take the last edit back', {'ctrl+z': () => byId('undo').click()}],
    ];
    return [
      ['Look', [
        ['drag, arrows', 'turn', each(turns, (key) => this.look('turn', ...turns[key]))],
        ...this.lookKeys(),
        ['shift+drag', 'move the picture'],
        ['w a s d, q, e', 'fly; down, up', each(kFlights, (key) => this.fly(key))],
      ]],
      ['Read', [
        ['click', 'what a point is, and where'],
        ['second click', 'how far it is from the first'],
        ['click, shift+click', 'choose an object, several'],
        ['esc', 'forget points and what is chosen', {Escape: () => { this.points = []; this.objects.choose(0); this.changed(); }}],
        ...(this.isLive ? edits : []),
      ]],
    ];
  }

  /// As long as a key of kFlights is held.
  fly(key) {
    const isUnderWay = this.flying.size > 0;
    this.flying.add(key);
    if (isUnderWay) return;
    let before = performance.now();
    const step = (now) => {
      const share = Math.min(0.1, (now - before) / 1000) * 0.25;
      before = now;
      for (const held of this.flying) this.look('fly', ...kFlights[held].map((v) => v * share));
      if (this.flying.size > 0) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  // A picture, and a path of the camera.

  /// The way through the views as states of the camera, `perLeg` from each to the next.
  path(perLeg) {
    const out = this.views.slice(0, 1);
    for (let i = 1; i < this.views.length; ++i) {
      for (let k = 1; k <= perLeg; ++k) out.push(between(this.views[i - 1], this.views[i], k / perLeg));
    }
    return out;
  }
  /// world_from_camera by rows, a line for each picture, as `semfield render --trajectory` reads it.
  pathText() {
    const now = this.camera.state();
    const rows = this.path(48).map((state) => Object.assign(this.camera, state).worldFromCamera().flat());
    Object.assign(this.camera, now);
    return rows.map((row) => row.map((v) => v.toPrecision(9)).join(' ') + '\n').join('');
  }
  play() {
    const begin = performance.now();
    const states = this.path(120);
    const step = (now) => {
      const at = Math.min(states.length - 1, Math.floor((now - begin) * 0.06));
      Object.assign(this.camera, states[at], {target: [...states[at].target]});
      this.looked();
      if (at < states.length - 1) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }
  /// What is seen, as a PNG: the mesh, or the rendered picture over it, and what is marked and measured.
  async picture() {
    const both = make('canvas', {width: this.canvas.width, height: this.canvas.height});
    const context = both.getContext('2d');
    context.drawImage(this.canvas, 0, 0);
    if (this.live?.image) context.drawImage(byId('still'), 0, 0, both.width, both.height);
    const marks = make('img', {src: `data:image/svg+xml,${encodeURIComponent(new XMLSerializer().serializeToString(byId('marks')))}`});
    await marks.decode();
    context.drawImage(marks, 0, 0, both.width, both.height);
    return new Promise((done) => both.toBlob(done, 'image/png'));
  }

  // Drawing and reading.

  /// The camera or the colours are others; after redraw() alone they stay, and so does the rendered picture.
  changed() {
    this.live?.drop();
    super.changed();
  }
  looked() { this.changed(); }

  draw() {
    this.drawMesh();
    const {isInside} = this.camera;
    const colors = [...byId('colors').children].map(({id}) => [id, id === this.mode]);
    setPressed({inside: isInside, outside: !isInside, ...Object.fromEntries(colors)});
    const [nearest, farthest] = this.camera.depths().map((v) => `${lengthText(v, this.facts, 2)} ${this.facts.unit}`);
    showLegend({entropy: ['certain', `${this.facts.entropy.toPrecision(2)} nats`], depth: [farthest, nearest]}[this.mode]);
    this.drawMarks();
    this.tellPoints();
    this.objects.tell();
    const count = this.views.length;
    for (const [id, least] of [['play', 2], ['save-path', 2], ['clear', 1]]) byId(id).disabled = count < least;
    setText(byId('path-hint'), count === 0 ? 'Fly somewhere and add a view; do so again: the path leads through all of them.'
      : `${count} view${count === 1 ? '' : 's'}, ${2 * (count - 1)} s`);
  }

  /// Lighter while the camera moves, where the whole takes long, and then whole.
  drawMesh() {
    const seen = JSON.stringify(this.camera.state());
    const isLight = this.drawing.isSlow && seen !== this.drawnFrom;
    const what = [this.layer, kMode[this.mode], this.camera.matrices()];
    this.drawnFrom = seen;
    this.layer.depthRange = this.camera.depths();
    clearTimeout(this.rest);
    if (!isLight) return this.drawing.drawFine(...what);
    this.drawing.draw(...what, true);
    this.rest = setTimeout(() => this.drawMesh(), kStill_ms);
  }

  /// What lies under a point of the canvas: {place, label, object}, or null.
  read(x, y) {
    const {width, height, ratio} = this.camera.screen;
    const column = Math.floor(x * this.canvas.width / width);
    const row = Math.floor(y * this.canvas.height / height);
    const found = this.drawing.read(this.layer, this.camera.matrices(), column, this.canvas.height - 1 - row);
    if (found === null) return null;
    return {place: this.camera.unprojected((column + 0.5) / ratio, (row + 0.5) / ratio, found[0] / 16777215), label: found[1], object: found[2]};
  }

  point(x, y, more) {
    const found = this.read(x, y);
    if (this.points.length === 2 || found === null) this.points = [];
    if (found !== null) this.points.push(found);
    this.objects.choose(found === null ? 0 : found.object, more);
    if (found !== null) this.live?.askPoint(found);
    this.redraw();
  }

  drawMarks() {
    const element = (name, values) => {
      const one = document.createElementNS('http://www.w3.org/2000/svg', name);
      for (const [key, value] of Object.entries(values)) one.setAttribute(key, value);
      return one;
    };
    const line = (ends, kind, look) => {
      const [from, to] = ends.map((place) => this.camera.toScreen(place));
      return from && to ? [element('line', {x1: from[0], y1: from[1], x2: to[0], y2: to[1], class: kind, ...look})] : [];
    };
    const {width, height} = this.camera.screen;
    const places = this.points.map(({place}) => place);
    const seen = places.map((place) => this.camera.toScreen(place)).filter(Boolean);
    const dots = seen.map(([cx, cy]) => element('circle', {cx, cy, r: 5, fill: kMark, stroke: '#14161a', 'stroke-width': 1.5}));
    const measure = places.length === 2 ? line(places, 'measure', {stroke: kMark, 'stroke-width': 2}) : [];
    if (measure.length > 0) {
      const within = (v, margin, most) => Math.max(margin, Math.min(most - margin, v));
      const at = {x: within((seen[0][0] + seen[1][0]) / 2, 50, width), y: within((seen[0][1] + seen[1][1]) / 2 - 10, 20, height)};
      measure.push(element('text', {...at, 'text-anchor': 'middle', fill: kMark, stroke: '#14161a', 'stroke-width': 4, 'paint-order': 'stroke', 'font-family': 'sans-serif', 'font-size': 15, 'font-weight': 600}));
      measure[1].textContent = this.distanceText();
    }
    const boxes = this.objects.edges().flatMap((ends) => line(ends, 'box', {stroke: '#fff', opacity: 0.8}));
    for (const [key, value] of Object.entries({width, height})) byId('marks').setAttribute(key, value);
    byId('marks').replaceChildren(...boxes, ...measure, ...dots);
  }

  distanceText() { return `${lengthText(distance(this.points[0].place, this.points[1].place), this.facts)} ${this.facts.unit}`; }

  tellPoints() {
    const {unit, labels, classes} = this.facts;
    const lines = this.points.map(({told, label, place}) => {
      const name = labels ? `${told ?? classes[label]?.name ?? 'no class'} at ` : '';
      return `${name}${place.map((v) => lengthText(v, this.facts)).join(', ')} ${unit}`;
    });
    if (this.points.length === 2) lines.push(`distance ${this.distanceText()}`);
    setText(byId('readout'), lines.join('\n'));
  }
}

async function openPage() {
  if (typeof DecompressionStream === 'undefined') throw new Error('This browser is too old for this page: take one of 2023 or later.');
  document.body.classList.toggle('inside', kInside);
  const [told, mesh] = [byId('facts'), byId('mesh')];  // of a file that stands alone
  const facts = told && JSON.parse(told.textContent);
  const scene = facts ? {facts, mesh: unpacked(await inflated(bytesOf(mesh.textContent)), facts)} : await liveScene(0);
  mesh?.remove();
  document.body.dataset.state = 'ready';  // the panel has a size from here on
  window.semfield = new ViewPage(scene, facts === null);
}

openPage().catch(({message, remedy}) => {
  document.body.dataset.state = 'failed';
  new Messages().refuse(message, remedy);
});

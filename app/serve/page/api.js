// Requests to the program. All addresses are relative, so they carry the page's secret folder.
import {safeStorage, store, stored} from './dom.js';

const kLongest_ms = 3600e3;  // for a fine mesh, which takes its time

/// What the program says begins small and ends open.
export const sentence = (text) => (text ? text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? '' : '.') : '');

/// What the program refused: a sentence, what to do about it, and the HTTP status (0: no response came).
export class Refusal extends Error {
  constructor(what, remedy, status) {
    super(what);
    this.remedy = remedy ?? '';
    this.status = status;
  }
  /// No response, or one that says "later": the same request may succeed in a while.
  get passes() { return this.status === 0 || this.status >= 500 || this.status === 429; }
  /// It answers, but not to this page: another run, or a start with another token.
  get isElsewhere() { return this.status === 403 || this.status === 404; }
  get inWords() { return `${sentence(this.message)} ${sentence(this.remedy)}`.trim(); }
}

/// options.signal: in place of the time after which nobody waits any longer.
async function answered(path, options, timeout_ms) {
  let answer;
  try {
    answer = await fetch(path, {signal: AbortSignal.timeout(timeout_ms), credentials: 'omit', cache: 'no-store', ...options});
  } catch {
    throw new Refusal('The program does not answer.', 'Look whether it still runs.', 0);
  }
  if (answer.ok) return answer;
  let told = {};
  try {
    told = await answer.json();
  } catch { /* not JSON: a proxy, or another server on this port */ }
  const what = told.error?.replace(/^(event '[\w-]+'|request): /, '');  // the page knows what it sent
  throw new Refusal(what ?? `The program answered ${answer.status}.`, told.remedy, answer.status);
}

/// The body, all of it; a connection that breaks on the way is a Refusal too.
async function body(answer, kind) {
  try {
    return await answer[kind]();
  } catch {
    throw new Refusal('The answer broke off.', 'Look whether the program still runs.', 0);
  }
}

/// name: the state's word for the photograph of now; with it the browser may keep the picture for ever.
export const photoAddress = (view, name, most_px = 0) => `./photo?view=${view}&photo=${name}${most_px ? `&most_px=${most_px}` : ''}`;
export const getJson = async (path, timeout_ms = 30000) => body(await answered(path, {}, timeout_ms), 'json');
export const getBitmap = async (path) => createImageBitmap(await body(await answered(path, {cache: 'default'}, 60000), 'blob'));
const post = (path, value, options) =>
  answered(path, {method: 'POST', headers: {'Content-Type': 'application/json'}, body: JSON.stringify(value), ...options}, 120000);
export const postJson = async (path, value) => body(await post(path, value), 'json');
/// signal: ends the request.
export const postBitmap = async (path, value, signal) => createImageBitmap(await body(await post(path, value, {signal}), 'blob'));

/// Parts of an answer: bytes behind their length, u32 little-endian.
export function answerParts(buffer) {
  const view = new DataView(buffer);
  const parts = [];
  for (let at = 0; at < buffer.byteLength; at += 4 + parts.at(-1).length) {
    const length = view.getUint32(at, true);
    if (at + 4 + length > buffer.byteLength) throw new Refusal('An answer came incomplete.', '', 0);
    parts.push(new Uint8Array(buffer, at + 4, length));
  }
  return parts;
}
const jsonOf = (bytes) => JSON.parse(new TextDecoder().decode(bytes));

const decoded = (bytes, type) => (bytes.length ? createImageBitmap(new Blob([bytes], {type})) : null);

/// A picture with bitmaps `color`, `labels`, `entropy` or null.
export async function getPicture(request) {
  const [head, ...images] = answerParts(await body(await post('./picture', request), 'arrayBuffer'));
  const [color, labels, entropy] = await Promise.all(images.map((bytes, i) => decoded(bytes, i ? 'image/png' : 'image/jpeg')));
  return {...jsonOf(head), color, labels, entropy};
}

/// What a thing is: {outlines, level, least, most, share, class_guess, stale}; its mask is not decoded.
export const getThing = async (request) => jsonOf(answerParts(await body(await post('./thing', request), 'arrayBuffer'))[0]);

/// The facts of a scene and its mesh, deflated.
export async function getScene(number) {
  const [facts, mesh] = answerParts(await body(await answered(`./surface?mesh=${number}`, {}, kLongest_ms), 'arrayBuffer'));
  return {facts: jsonOf(facts), mesh};
}

const kBackoff_ms = [300, 700, 1500, 3000, 5000];

/// Waits that grow up to 5 s; poke() ends one.
export class Backoff {
  constructor() { this.reset(); }
  reset() { this.failures = 0; }
  poke() { this.wake?.(); }
  wait() {
    const most_ms = kBackoff_ms[Math.min(this.failures++, kBackoff_ms.length - 1)];
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, most_ms);
      this.wake = () => { clearTimeout(timer); resolve(); };
    });
  }
}

const seenOrHidden = () => new Promise((resolve) => document.addEventListener('visibilitychange', resolve, {once: true}));

/// Follows the program's state for ever, except in a tab that nobody sees (a browser has few connections to one server).
/// state(value, anew): what has changed since the last one; anew: all of it, after the first response, a rest and each lost connection;
/// lost(error): no response came, or none that helps (its status says which).
export async function followState({state, lost}) {
  const backoff = new Backoff();
  addEventListener('online', () => backoff.poke());
  for (let after = 0;;) {
    if (document.hidden && after !== 0) {
      while (document.hidden) await seenOrHidden();
      after = 0;
    }
    try {
      const value = await getJson(`./state?after=${after}`);
      const anew = after === 0 || value.revision < after;  // another process then, which sends all
      after = value.revision;
      backoff.reset();
      state(value, anew);
    } catch (error) {
      if (!(error instanceof Refusal)) console.error(error);
      after = 0;
      lost(error);
      await backoff.wait();
    }
  }
}

// The queue of events that the program has not acknowledged: kept in the browser's storage, sent in order, sent again with the same id.

const kPrefix = 'semfield.unsent.';

const random = (n) => Array.from(crypto.getRandomValues(new Uint8Array(n)), (v) => 'abcdefghijklmnopqrstuvwxyz234567'[v % 32]).join('');

/// Ids of one tab: the browser's part is kept, so that a later visit knows its own clicks.
export class Ids {
  constructor(storage = safeStorage('localStorage')) {
    this.browser = storage.getItem('semfield.browser') ?? random(8);
    storage.setItem('semfield.browser', this.browser);
    this.tab = `${this.browser}-${random(6)}`;
    this.count = 0;
  }
  next() { return `${this.tab}-${++this.count}`; }
  isOurs(id) { return id.startsWith(this.browser + '-'); }
}

export class EventQueue {
  /// changed(): the queue is another; acknowledged(event, response); refused(event, error).
  constructor({tab, changed, acknowledged, refused, failed, storage = safeStorage('localStorage'), send = (event) => postJson('./event', event)}) {
    Object.assign(this, {tab, changed, acknowledged, refused, failed, storage, send});
    this.unsent = [];
    this.backoff = new Backoff();
    this.pumping = false;
  }

  /// From now on events are kept for this run, and what earlier visits left unsent is taken over.
  open(run) {
    const folder = `${kPrefix}${run}.`;
    if (this.key === folder + this.tab) return;
    this.key = folder + this.tab;
    const keys = Array.from({length: this.storage.length}, (_, i) => this.storage.key(i));
    for (const key of keys.filter((name) => name?.startsWith(folder) && name !== this.key)) {
      const known = new Set(this.unsent.map((event) => event.id));
      this.unsent.push(...stored(this.storage, key, []).filter((event) => !known.has(event.id)));
      this.storage.removeItem(key);
    }
    this.keep();
    this.pump();
  }

  add(event) {
    this.unsent.push(event);
    this.keep();
    this.pump();
  }

  poke() { this.backoff.poke(); }

  keep() {
    if (this.key && this.unsent.length) store(this.storage, this.key, this.unsent);
    else if (this.key) this.storage.removeItem(this.key);
    this.changed();
  }

  async pump() {
    if (this.pumping) return;
    this.pumping = true;
    while (this.unsent.length) {
      const event = this.unsent[0];
      try {
        const answer = await this.send(event);
        this.backoff.reset();
        this.unsent.shift();
        this.acknowledged(event, answer);
      } catch (error) {
        if (!(error instanceof Refusal)) console.error(error);
        // Of a program that was started anew under another address, the event is not at fault.
        if (!(error instanceof Refusal) || error.passes || error.isElsewhere) {
          this.failed(error);
          await this.backoff.wait();
          continue;
        }
        this.unsent.shift();
        this.refused(event, error);
      }
      this.keep();
    }
    this.pumping = false;
  }
}

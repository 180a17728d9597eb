// The queue of events that the program has not acknowledged: kept in the browser's storage, sent in order, sent again with the same id.
import {Backoff, Refusal, postJson} from './api.js';
import {safeStorage} from './dom.js';

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
      try {
        const known = new Set(this.unsent.map((event) => event.id));
        this.unsent.push(...JSON.parse(this.storage.getItem(key)).filter((event) => !known.has(event.id)));
      } catch { /* not ours to read: it goes */ }
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
    if (this.key) {
      try {
        if (this.unsent.length) this.storage.setItem(this.key, JSON.stringify(this.unsent));
        else this.storage.removeItem(this.key);
      } catch { /* full: what is unsent lives on in memory */ }
    }
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
        // 403 and 404 are of a program that was started anew under another address: the event is not at fault.
        if (!(error instanceof Refusal) || error.passes || error.status === 403 || error.status === 404) {
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

// What a person set in this browser: opacity, brush, keys of classes. Kept from visit to visit.
import {safeStorage} from './events.js';

const kKey = 'semfield.settings';
const kFirst = {opacity: 55, radius: 3, names: false, digits: {}};

export class Settings {
  constructor(storage = safeStorage('localStorage')) {
    this.storage = storage;
    Object.assign(this, structuredClone(kFirst));
    try {
      const kept = JSON.parse(storage.getItem(kKey) ?? '{}');
      for (const name of Object.keys(kFirst)) if (typeof kept[name] === typeof kFirst[name]) this[name] = kept[name];
    } catch { /* not ours to read */ }
  }

  set(values) {
    Object.assign(this, values);
    const {opacity, radius, names, digits} = this;
    try {
      this.storage.setItem(kKey, JSON.stringify({opacity, radius, names, digits}));
    } catch { /* full: forgotten at a reload */ }
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
